//! Rays waiting for a split, as the body of an object.
//!
//! Inside the envelope (LZ4) stand four counts (u32): camera rays, path rays, shadow rays, 0. Then the three sections, each by
//! columns, each column by planes of bytes, the lowest first (structure of arrays twice over: bytes of one meaning stand
//! together, which is what LZ4 can use). Rays are sorted by (pixel, sample, branch, vertex, ..): neighbours in the
//! picture are neighbours here, and differences to the one before are small.
//!
//! | column | before it becomes planes | section |
//! |---|---|---|
//! | pixel | difference to the ray before | all |
//! | sample (full) | xor with the ray before | all |
//! | branch, vertex | xor with the ray before | path, shadow |
//! | origin x, y, z | bits, zigzag difference to the ray before | path, shadow |
//! | direction (full) | the two words of its code | path, shadow |
//! | throughput or contribution r | bits, zigzag difference to the ray before | path, shadow |
//! | throughput or contribution g, b | bits, xor with r, g: 0 for grey | path, shadow |
//! | pdf | bits | path |
//! | tmax | bits | shadow |
//! | candidate? | a bit a ray | camera, path |
//! | candidate t, prim, split | bits; xor with the candidate before | camera, path, those that have one |
//! | progress, owner | xor with the ray before | all |
//!
//! A column begins with its number of planes (u8), the fewest that hold its largest value. A full column has no such
//! byte and all its planes (sample 3, direction 8), so that bytes bound the number of rays and with it the reader's memory.
//!
//! A camera ray (vertex 0) is a function of its key, so its direction and throughput do not travel.
//!
//! Before compression a path ray takes at most 65 bytes and a bit (63 below 256 vertices and 256 owners of a cell).

mod columns;
#[cfg(test)]
mod tests;

use std::cmp::Ordering;

use bytes::Bytes;
use rayherd_render::frame::Frame;
use rayherd_render::math::UnitDir;
use rayherd_render::path::{PathRay, ShadowRay, camera_ray};
use rayherd_render::ray::PathKey;
use rayherd_render::sampler::{MAX_SAMPLES, MAX_SPLIT};
use rayherd_scene::grid::Progress;

use self::columns::{Reader, Writer};
use super::envelope::{Compress, Kind, WireError, open, seal};
use crate::flight::{Candidate, Flights, PathFlight, ShadowFlight, Visit};

/// Most rays of one object: what a reader allocates is bounded by it, whatever the bytes say. Larger groups are several objects.
pub const MAX_RAYS: usize = 1 << 20;
/// Most bytes of a ray before compression.
const MAX_BYTES: usize = 68;

/// Rays as an object. Their order does not survive: the same rays give the same bytes.
///
/// # Errors
/// `TooLarge` above [`MAX_RAYS`].
pub fn encode(frame: &Frame, rays: &Flights) -> Result<Bytes, WireError> {
    check_count(rays.len() as u64)?;
    Ok(seal(Kind::RayGroup, &encode_payload(frame, rays), Compress::Lz4))
}

/// Rays from an object, sorted.
///
/// That their splits and cells exist is for the caller to check: this knows no scene.
pub fn decode(frame: &Frame, body: &[u8]) -> Result<Flights, WireError> {
    decode_payload(frame, &open(Kind::RayGroup, body, MAX_RAYS * MAX_BYTES)?)
}

fn check_count(count: u64) -> Result<(), WireError> {
    let limit = MAX_RAYS as u64;
    if count <= limit { Ok(()) } else { Err(WireError::TooLarge { what: "rays", count, limit }) }
}

fn encode_payload(frame: &Frame, rays: &Flights) -> Vec<u8> {
    let (mut camera, mut paths): (Vec<&PathFlight>, Vec<&PathFlight>) =
        rays.paths.iter().partition(|f| is_camera_ray(frame, &f.ray));
    camera.sort_unstable_by(|a, b| path_order(a, b));
    paths.sort_unstable_by(|a, b| path_order(a, b));
    let mut shadows: Vec<&ShadowFlight> = rays.shadows.iter().collect();
    shadows.sort_unstable_by(|a, b| shadow_order(a, b));

    let mut w = Writer::default();
    for count in [camera.len(), paths.len(), shadows.len(), 0] {
        w.word(count as u32);
    }
    write_keys(&mut w, &camera, |f| f.ray.key, false);
    write_candidates(&mut w, &camera);
    write_visits(&mut w, &camera, |f| f.visit);

    write_keys(&mut w, &paths, |f| f.ray.key, true);
    write_segment(&mut w, &paths, |f| (f.ray.o, f.ray.dir, f.ray.throughput));
    w.narrow(paths.iter().map(|f| f.ray.pdf.to_bits()));
    write_candidates(&mut w, &paths);
    write_visits(&mut w, &paths, |f| f.visit);

    write_keys(&mut w, &shadows, |f| f.ray.key, true);
    write_segment(&mut w, &shadows, |f| (f.ray.o, f.ray.dir, f.ray.contribution));
    w.narrow(shadows.iter().map(|f| f.ray.tmax.to_bits()));
    write_visits(&mut w, &shadows, |f| f.visit);
    w.bytes
}

fn decode_payload(frame: &Frame, payload: &[u8]) -> Result<Flights, WireError> {
    let mut r = Reader::new(payload);
    let [camera, paths, shadows, reserved] = [r.word()?, r.word()?, r.word()?, r.word()?];
    if reserved != 0 {
        return Err(WireError::corrupt("ray group with a fourth section"));
    }
    // the full columns: what is announced must be there before anything is allocated
    check_count(u64::from(camera) + u64::from(paths) + u64::from(shadows))?;
    let least = u64::from(camera) * 3 + (u64::from(paths) + u64::from(shadows)) * 11;
    if least > payload.len() as u64 {
        return Err(WireError::corrupt("ray group of more rays than it has bytes for"));
    }
    let [camera, paths, shadows] = [camera, paths, shadows].map(|n| n as usize);
    let mut out = Flights::default();
    out.paths.reserve_exact(camera + paths);
    out.shadows.reserve_exact(shadows);

    let keys = read_keys(&mut r, frame, camera, false)?;
    let candidates = read_candidates(&mut r, camera)?;
    let visits = read_visits(&mut r, camera)?;
    for ((key, candidate), visit) in keys.into_iter().zip(candidates).zip(visits) {
        out.paths.push(PathFlight { ray: camera_ray(frame, key.pixel, key.sample), candidate, visit });
    }

    let keys = read_keys(&mut r, frame, paths, true)?;
    let segments = read_segment(&mut r, paths)?;
    let pdf = r.narrow(paths)?;
    let candidates = read_candidates(&mut r, paths)?;
    let visits = read_visits(&mut r, paths)?;
    for i in 0..paths {
        let (o, dir, throughput) = segments[i];
        let ray = PathRay { o, dir, key: keys[i], throughput, pdf: f32::from_bits(pdf[i]) };
        out.paths.push(PathFlight { ray, candidate: candidates[i], visit: visits[i] });
    }

    let keys = read_keys(&mut r, frame, shadows, true)?;
    let segments = read_segment(&mut r, shadows)?;
    let tmax = r.narrow(shadows)?;
    let visits = read_visits(&mut r, shadows)?;
    for i in 0..shadows {
        let (o, dir, contribution) = segments[i];
        let ray = ShadowRay { o, dir, tmax: f32::from_bits(tmax[i]), contribution, key: keys[i] };
        out.shadows.push(ShadowFlight { ray, visit: visits[i] });
    }
    r.end()?;
    check_canonical(frame, &out, camera)?;
    Ok(out)
}

/// The same rays have one encoding: sorted, and each in its section.
fn check_canonical(frame: &Frame, rays: &Flights, camera: usize) -> Result<(), WireError> {
    let (first, rest) = rays.paths.split_at(camera);
    let sorted = first.is_sorted_by(|a, b| path_order(a, b).is_le())
        && rest.is_sorted_by(|a, b| path_order(a, b).is_le())
        && rays.shadows.is_sorted_by(|a, b| shadow_order(a, b).is_le());
    if sorted && !rest.iter().any(|f| is_camera_ray(frame, &f.ray)) {
        return Ok(());
    }
    Err(WireError::corrupt("ray group out of order"))
}

fn is_camera_ray(frame: &Frame, ray: &PathRay) -> bool {
    let PathKey { pixel, sample, branch, vertex } = ray.key;
    // compared by their bits, lest -0 becomes 0
    (branch, vertex) == (0, 0) && bytemuck::bytes_of(ray) == bytemuck::bytes_of(&camera_ray(frame, pixel, sample))
}

/// By key; after it by everything else (two rays of one key are hardly ever there), so that only what is the same is equal.
fn path_order(a: &PathFlight, b: &PathFlight) -> Ordering {
    let rest = |f: &PathFlight| {
        let (c, v) = (f.candidate, f.visit);
        let ray = segment_bits(f.ray.o, f.ray.dir, f.ray.throughput);
        (ray, f.ray.pdf.to_bits(), c.t.to_bits(), c.prim, c.split, v.progress, v.owner)
    };
    a.ray.key.cmp(&b.ray.key).then_with(|| rest(a).cmp(&rest(b)))
}

fn shadow_order(a: &ShadowFlight, b: &ShadowFlight) -> Ordering {
    let rest = |f: &ShadowFlight| {
        let ray = segment_bits(f.ray.o, f.ray.dir, f.ray.contribution);
        (ray, f.ray.tmax.to_bits(), f.visit.progress, f.visit.owner)
    };
    a.ray.key.cmp(&b.ray.key).then_with(|| rest(a).cmp(&rest(b)))
}

fn segment_bits(o: [f32; 3], dir: UnitDir, rgb: [f32; 3]) -> [u32; 8] {
    let ([x, y, z], [a, b], [r, g, blue]) = (o.map(f32::to_bits), dir.to_words(), rgb.map(f32::to_bits));
    [x, y, z, a, b, r, g, blue]
}

fn write_keys<T>(w: &mut Writer, rays: &[T], key: impl Fn(&T) -> PathKey, bounced: bool) {
    w.narrow(columns::steps(rays.iter().map(|f| key(f).pixel)));
    w.full(3, columns::changes(rays.iter().map(|f| key(f).sample)));
    if bounced {
        w.narrow(columns::changes(rays.iter().map(|f| u32::from(key(f).branch))));
        w.narrow(columns::changes(rays.iter().map(|f| u32::from(key(f).vertex))));
    }
}

fn read_keys(r: &mut Reader, frame: &Frame, n: usize, bounced: bool) -> Result<Vec<PathKey>, WireError> {
    let pixels = frame.size[0] * frame.size[1];
    let pixel = columns::undo_steps(r.narrow(n)?);
    let sample = columns::undo_changes(r.full(3, n)?);
    let (branch, vertex): (Vec<u32>, Vec<u32>) = if bounced {
        (columns::undo_changes(r.narrow(n)?), columns::undo_changes(r.narrow(n)?))
    } else {
        (vec![0; n], vec![0; n])
    };
    let key = |i: usize| {
        let inside = pixel[i] < pixels && sample[i] < MAX_SAMPLES && branch[i] < MAX_SPLIT && vertex[i] <= 0xffff;
        let key = PathKey { pixel: pixel[i], sample: sample[i], branch: branch[i] as u16, vertex: vertex[i] as u16 };
        inside.then_some(key).ok_or_else(|| WireError::corrupt(format!("ray {i} of no path of this picture")))
    };
    (0..n).map(key).collect()
}

type Segment = ([f32; 3], UnitDir, [f32; 3]);

fn write_segment<T>(w: &mut Writer, rays: &[T], segment: impl Fn(&T) -> Segment) {
    for axis in 0..3 {
        w.narrow(columns::zigzag_steps(rays.iter().map(|f| segment(f).0[axis].to_bits())));
    }
    for word in 0..2 {
        w.full(4, rays.iter().map(|f| segment(f).1.to_words()[word]));
    }
    let channel = |f: &T, c: usize| segment(f).2[c].to_bits();
    w.narrow(columns::zigzag_steps(rays.iter().map(|f| channel(f, 0))));
    w.narrow(rays.iter().map(|f| channel(f, 1) ^ channel(f, 0)));
    w.narrow(rays.iter().map(|f| channel(f, 2) ^ channel(f, 1)));
}

fn read_segment(r: &mut Reader, n: usize) -> Result<Vec<Segment>, WireError> {
    let mut axis = || Ok(columns::undo_zigzag_steps(r.narrow(n)?));
    let [x, y, z] = [axis()?, axis()?, axis()?];
    let [a, b] = [r.full(4, n)?, r.full(4, n)?];
    let red = columns::undo_zigzag_steps(r.narrow(n)?);
    let [green, blue]: [Vec<u32>; 2] = [r.narrow(n)?, r.narrow(n)?];
    let segment = |i: usize| {
        let dir = UnitDir::from_words([a[i], b[i]]);
        let dir = dir.ok_or_else(|| WireError::corrupt(format!("direction of ray {i} is no code of one")))?;
        let (r, g) = (red[i], red[i] ^ green[i]);
        let rgb = [r, g, g ^ blue[i]].map(f32::from_bits);
        Ok(([x[i], y[i], z[i]].map(f32::from_bits), dir, rgb))
    };
    (0..n).map(segment).collect()
}

fn write_candidates(w: &mut Writer, rays: &[&PathFlight]) {
    let found: Vec<Candidate> = rays.iter().map(|f| f.candidate).filter(|c| *c != Candidate::NONE).collect();
    w.bits(rays.iter().map(|f| f.candidate != Candidate::NONE));
    w.narrow(found.iter().map(|c| c.t.to_bits()));
    w.narrow(columns::changes(found.iter().map(|c| c.prim)));
    w.narrow(columns::changes(found.iter().map(|c| c.split)));
}

fn read_candidates(r: &mut Reader, n: usize) -> Result<Vec<Candidate>, WireError> {
    let found = r.bits(n)?;
    let m = found.iter().filter(|&&bit| bit).count();
    let t = r.narrow(m)?;
    let prim: Vec<u64> = columns::undo_changes(r.narrow(m)?);
    let split = columns::undo_changes(r.narrow(m)?);
    let all = t.into_iter().zip(prim).zip(split);
    let mut all = all.map(|((t, prim), split)| Candidate { t: f32::from_bits(t), prim, split });
    let mut next = |found| if found { all.next().unwrap_or(Candidate::NONE) } else { Candidate::NONE };
    Ok(found.into_iter().map(&mut next).collect())
}

fn write_visits<T>(w: &mut Writer, rays: &[T], visit: impl Fn(&T) -> Visit) {
    w.narrow(columns::changes(rays.iter().map(|f| visit(f).progress.0)));
    w.narrow(columns::changes(rays.iter().map(|f| u32::from(visit(f).owner))));
}

fn read_visits(r: &mut Reader, n: usize) -> Result<Vec<Visit>, WireError> {
    let progress = columns::undo_changes(r.narrow(n)?);
    let owner: Vec<u32> = columns::undo_changes(r.narrow(n)?);
    let visit = |(progress, owner): (u32, u32)| {
        let owner = u16::try_from(owner).map_err(|_| WireError::corrupt("a cell of more than 65536 owners"))?;
        Ok(Visit { progress: Progress(progress), owner })
    };
    progress.into_iter().zip(owner).map(visit).collect()
}
