//! Every primitive tried with every ray: the plainest intersector, with the kernel's rules (watertight triangles, ties to the
//! smaller id).

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::Vec3;

use crate::aov::Aovs;
use crate::camera::Camera;
use crate::filter::Filter;
use crate::frame::Frame;
use crate::light::{Lights, SkyMap};
use crate::material::{Bsdf, Detail, Material, Slot, Textured};
use crate::path::reference::Tracer;
use crate::path::{Surface, Surfaces};
use crate::ray::{Hit, MISS, PrimId, Ray};
use crate::texture::{Bitmap, Filter as TexelFilter, Texel, Texture, Tiles, UvMap, Wrap};
use crate::world::{Beam, EmissivePrimitive, Environment, Glow, Primitive, ShapeInfo, Sun, World};

/// A scene in a list.
#[derive(Default)]
pub struct Scene {
    pub primitives: Vec<(Primitive, u32)>,
    pub normals: Vec<Option<[[f32; 3]; 3]>>,
    pub materials: Vec<Material>,
    pub shapes: Vec<ShapeInfo>,
    pub beams: Vec<Beam>,
    pub environment: Option<[f32; 3]>,
    /// In place of `environment`: a picture, and rows of the rotation to it.
    pub sky_map: Option<(Arc<SkyMap>, [[f32; 3]; 3])>,
    pub sun: Option<Sun>,
    pub textures: Vec<Texture>,
    pub tiles: Tiles,
    /// By primitive: its texture coordinates and attribute.
    pub extras: BTreeMap<u32, Extras>,
}

type Extras = (Option<[[f32; 2]; 3]>, Option<[[f32; 3]; 3]>);

impl Scene {
    pub fn material(&mut self, bsdf: Bsdf, two_sided: bool) -> u32 {
        self.materials.push(Material::new("", bsdf, two_sided));
        self.materials.len() as u32 - 1
    }

    /// A material with detail.
    pub fn detailed(&mut self, bsdf: Bsdf, detail: Detail) -> u32 {
        let n = self.material(bsdf, true);
        self.materials[n as usize].detail = Some(Box::new(detail));
        n
    }

    /// A diffuse material whose albedo a texture gives.
    pub fn painted(&mut self, texture: u32) -> u32 {
        let textured = vec![Textured::new(Slot::Diffuse, texture)];
        self.detailed(Bsdf::Diffuse { reflectance: [0.0; 3] }, Detail { textured, ..Detail::default() })
    }

    /// An image of bytes as they are, 3 channels, of one tile.
    pub fn image(&mut self, size: [u32; 2], bytes: Vec<u8>) -> u32 {
        let first_tile = self.tiles.push(bytes);
        self.textures.push(Texture::Bitmap(Bitmap {
            size,
            channels: 3,
            texel: Texel::Linear8,
            wrap: Wrap::Repeat,
            filter: TexelFilter::Bilinear,
            to_uv: UvMap::IDENTITY,
            first_tile,
        }));
        self.textures.len() as u32 - 1
    }

    pub fn diffuse(&mut self, albedo: f32) -> u32 {
        self.material(Bsdf::Diffuse { reflectance: [albedo; 3] }, true)
    }

    pub fn shape(&mut self, material: u32, emission: Option<[f32; 3]>) -> u32 {
        self.shapes.push(ShapeInfo { name: String::new(), material, emission, emission_texture: None });
        self.shapes.len() as u32 - 1
    }

    pub fn sphere(&mut self, shape: u32, center: [f32; 3], radius: f32, flipped: bool) {
        self.primitives.push((Primitive::Sphere { center, radius, flipped }, shape));
        self.normals.push(None);
    }

    /// A parallelogram from a corner; its front is where `a x b` points.
    pub fn quad(&mut self, shape: u32, corner: [f32; 3], a: [f32; 3], b: [f32; 3]) {
        let (o, a, b) = (Vec3::from(corner), Vec3::from(a), Vec3::from(b));
        for v in [[o, o + a, o + a + b], [o, o + a + b, o + b]] {
            self.primitives.push((Primitive::Triangle(v.map(|p| p.to_array())), shape));
            self.normals.push(None);
        }
    }

    pub fn world(&self) -> World {
        let (mut emissive, mut glows) = (Vec::new(), Vec::new());
        let (mut lo, mut hi) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for (i, &(geometry, shape)) in self.primitives.iter().enumerate() {
            match geometry {
                Primitive::Triangle(v) => v.iter().for_each(|&p| (lo, hi) = (lo.min(p.into()), hi.max(p.into()))),
                Primitive::Sphere { center, radius, .. } => {
                    let c = Vec3::from(center);
                    (lo, hi) = (lo.min(c - radius), hi.max(c + radius));
                }
            }
            if self.shapes[shape as usize].emission.is_some() {
                emissive.push(EmissivePrimitive { prim: i as u64, shape, geometry });
            }
            if self.shapes[shape as usize].emission_texture.is_some() {
                let (uv, attribute) = self.extras.get(&(i as u32)).copied().unwrap_or_default();
                glows.push(Glow { prim: i as u64, uv, attribute, weight: 1.0 });
            }
        }
        World {
            materials: self.materials.clone(),
            textures: self.textures.clone(),
            shapes: self.shapes.clone(),
            emissive,
            glows,
            beams: self.beams.clone(),
            environment: match &self.sky_map {
                Some((_, to_map)) => Some(Environment::Map { scale: 1.0, to_map: *to_map, upper: false }),
                None => self.environment.map(Environment::Constant),
            },
            sun: self.sun,
            lo: lo.to_array(),
            hi: hi.to_array(),
        }
    }
}

impl Scene {
    pub fn lights(&self) -> Lights {
        Lights::with_sky_map(&self.world(), self.sky_map.as_ref().map(|(map, _)| map.clone()))
    }
}

impl Surfaces for Scene {
    fn surface(&self, _index: usize, hit: &Hit) -> Surface {
        let (geometry, _) = self.primitives[hit.prim as usize];
        let (uv, attribute) = self.extras.get(&hit.prim).copied().unwrap_or_default();
        Surface { geometry, normals: self.normals[hit.prim as usize], uv, attribute }
    }
    fn shape(&self, _index: usize, hit: &Hit) -> u32 {
        self.primitives[hit.prim as usize].1
    }
    fn prim(&self, _index: usize, hit: &Hit) -> PrimId {
        hit.prim.into()
    }
}

impl Tracer for Scene {
    fn closest(&self, ray: &Ray) -> Hit {
        let mut best = Hit::miss(ray.tmax);
        for (i, (primitive, _)) in self.primitives.iter().enumerate() {
            let hit = match primitive {
                Primitive::Triangle(v) => triangle(ray, v),
                Primitive::Sphere { center, radius, .. } => sphere(ray, *center, *radius),
            };
            if let Some((t, u, v)) = hit
                && t > ray.tmin
                && (t < best.t || (t == best.t && best.prim == MISS))
            {
                best = Hit { t, u, v, prim: i as u32, leaf: 0, lane: 0 };
            }
        }
        best
    }

    fn occluded(&self, ray: &Ray) -> bool {
        self.closest(ray).is_hit()
    }
}

/// Woop, Benthin, Wald 2013.
fn triangle(ray: &Ray, v: &[[f32; 3]; 3]) -> Option<(f32, f32, f32)> {
    let m = ray.d.map(f32::abs);
    let kz = if m[0] > m[1] && m[0] > m[2] {
        0
    } else if m[1] > m[2] {
        1
    } else {
        2
    };
    let (kx, ky) = ((kz + 1) % 3, (kz + 2) % 3);
    let (sx, sy, sz) = (ray.d[kx] / ray.d[kz], ray.d[ky] / ray.d[kz], 1.0 / ray.d[kz]);
    let p = v.map(|p| {
        let q: [f32; 3] = std::array::from_fn(|i| p[i] - ray.o[i]);
        [q[kx] - sx * q[kz], q[ky] - sy * q[kz], sz * q[kz]]
    });
    let edge = |a: [f32; 3], b: [f32; 3]| {
        let e = a[0] * b[1] - a[1] * b[0];
        if e != 0.0 { f64::from(e) } else { f64::from(a[0]) * f64::from(b[1]) - f64::from(a[1]) * f64::from(b[0]) }
    };
    let (u, v, w) = (edge(p[2], p[1]), edge(p[0], p[2]), edge(p[1], p[0]));
    if (u < 0.0 || v < 0.0 || w < 0.0) && (u > 0.0 || v > 0.0 || w > 0.0) {
        return None;
    }
    let (u, v, w) = (u as f32, v as f32, w as f32);
    let det = u + v + w;
    if det == 0.0 {
        return None;
    }
    let t = (u * p[0][2] + v * p[1][2] + w * p[2][2]) / det;
    Some((t, v / det, w / det))
}

fn sphere(ray: &Ray, center: [f32; 3], radius: f32) -> Option<(f32, f32, f32)> {
    let f = Vec3::from(ray.o) - Vec3::from(center);
    let d = Vec3::from(ray.d);
    let a = d.length_squared();
    let b = -f.dot(d);
    // the discriminant from the distance to the axis (Haines et al. 2019, "Precision Improvements for Ray/Sphere Intersection")
    let l = f + d * (b / a);
    let disc = radius * radius - l.length_squared();
    if disc < 0.0 {
        return None;
    }
    let c = f.length_squared() - radius * radius;
    let q = b + f32::copysign((a * disc).sqrt(), b);
    let (t0, t1) = if q == 0.0 { (0.0, 0.0) } else { (c / q, q / a) };
    let (near, far) = (t0.min(t1), t0.max(t1));
    let t = if near > ray.tmin { near } else { far };
    (t > ray.tmin).then_some((t, 0.0, 0.0))
}

/// A frame seen from `eye` along +z turned by nothing: x to the left, y up.
pub fn frame(eye: [f64; 3], fov: f64, size: [u32; 2], max_depth: u32) -> Frame {
    let rows = [[1.0, 0.0, 0.0, eye[0]], [0.0, 1.0, 0.0, eye[1]], [0.0, 0.0, 1.0, eye[2]]];
    Frame {
        camera: Camera::new(&rows, fov, size, [0.0; 3]).unwrap(),
        size,
        filter: Filter::Box,
        seed: 1,
        max_depth,
        rr_depth: 1000,
        split: 1,
        hide_emitters: false,
        aovs: Aovs::NONE,
    }
}

/// The same, looking along -z.
pub fn frame_back(eye: [f64; 3], fov: f64, size: [u32; 2], max_depth: u32) -> Frame {
    let rows = [[-1.0, 0.0, 0.0, eye[0]], [0.0, 1.0, 0.0, eye[1]], [0.0, 0.0, -1.0, eye[2]]];
    Frame { camera: Camera::new(&rows, fov, size, [0.0; 3]).unwrap(), ..frame(eye, fov, size, max_depth) }
}
