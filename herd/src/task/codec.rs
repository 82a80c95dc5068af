//! Rays and film parts as the bodies of objects.

use bytemuck::{Pod, Zeroable};
use bytes::Bytes;
use rayherd_render::film::FilmPart;
use rayherd_render::frame::Frame;
use rayherd_render::path::{PathRay, ShadowRay};
use rayherd_scene::grid::Progress;

use crate::flight::{Candidate, Flights, PathFlight, ShadowFlight, Visit};
use crate::wire::WireError;
use crate::wire::envelope::{Compress, Kind, open, seal};

#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct Path {
    ray: PathRay,
    t: f32,
    prim: [u32; 2],
    split: u32,
    progress: u32,
    owner: u32,
}

#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct Shadow {
    ray: ShadowRay,
    progress: u32,
    owner: u32,
}

/// Largest body that is read.
const LIMIT: usize = 1 << 30;

/// Rays as an object.
pub fn encode_rays(_frame: &Frame, rays: &Flights) -> Bytes {
    let mut out = Vec::new();
    out.extend((rays.paths.len() as u32).to_le_bytes());
    out.extend((rays.shadows.len() as u32).to_le_bytes());
    for f in &rays.paths {
        let prim = [f.candidate.prim as u32, (f.candidate.prim >> 32) as u32];
        let (t, split) = (f.candidate.t, f.candidate.split);
        let p = Path { ray: f.ray, t, prim, split, progress: f.visit.progress.0, owner: f.visit.owner.into() };
        out.extend(bytemuck::bytes_of(&p));
    }
    for f in &rays.shadows {
        let s = Shadow { ray: f.ray, progress: f.visit.progress.0, owner: f.visit.owner.into() };
        out.extend(bytemuck::bytes_of(&s));
    }
    seal(Kind::RayGroup, &out, Compress::Lz4)
}

/// Rays from an object.
pub fn decode_rays(frame: &Frame, body: &[u8]) -> Result<Flights, WireError> {
    let payload = open(Kind::RayGroup, body, LIMIT)?;
    let cut = || WireError::corrupt("ray group is cut off");
    let (head, rest) = payload.split_at_checked(8).ok_or_else(cut)?;
    let word = |i: usize| u32::from_le_bytes(std::array::from_fn(|k| head[4 * i + k])) as usize;
    let (paths, shadows) = rest.split_at_checked(word(0) * size_of::<Path>()).ok_or_else(cut)?;
    if shadows.len() != word(1) * size_of::<Shadow>() {
        return Err(cut());
    }
    let pixels = frame.size[0] * frame.size[1];
    let mut out = Flights::default();
    for chunk in paths.chunks_exact(size_of::<Path>()) {
        let p: Path = bytemuck::pod_read_unaligned(chunk);
        let prim = u64::from(p.prim[0]) | u64::from(p.prim[1]) << 32;
        let visit = Visit { progress: Progress(p.progress), owner: p.owner as u16 };
        out.paths.push(PathFlight { ray: p.ray, candidate: Candidate { t: p.t, prim, split: p.split }, visit });
    }
    for chunk in shadows.chunks_exact(size_of::<Shadow>()) {
        let s: Shadow = bytemuck::pod_read_unaligned(chunk);
        let visit = Visit { progress: Progress(s.progress), owner: s.owner as u16 };
        out.shadows.push(ShadowFlight { ray: s.ray, visit });
    }
    let keys = out.paths.iter().map(|f| f.ray.key).chain(out.shadows.iter().map(|f| f.ray.key));
    if keys.into_iter().any(|k| k.pixel >= pixels) {
        return Err(WireError::corrupt("a ray of a pixel that is none"));
    }
    Ok(out)
}

/// A film part as an object.
pub fn encode_film(film: &FilmPart) -> Bytes {
    seal(Kind::FilmPart, &film.encode(), Compress::Lz4)
}

/// A film part from an object.
pub fn decode_film(size: [u32; 2], body: &[u8]) -> Result<FilmPart, WireError> {
    let payload = open(Kind::FilmPart, body, LIMIT)?;
    FilmPart::decode(&payload, size).map_err(|e| WireError::corrupt(e.to_string()))
}
