//! The format-free scene: what every importer yields and all that preparing knows.

use std::path::PathBuf;

use rayherd_render::aov::Aovs;
pub use rayherd_render::camera::Projection;
pub use rayherd_render::filter::Filter;
pub use rayherd_render::material::{
    Amount, Blend, Bsdf, Detail, Distribution, Material, Principled, Relief, ReliefKind, Slot, Textured, Transmittance,
};
pub use rayherd_render::texture::{Checkerboard, Filter as TexelFilter, UvMap, Wrap};
use serde::{Deserialize, Serialize};

/// Where in a source file something stands, for messages.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Place {
    /// The file.
    pub file: PathBuf,
    /// Line from 1; 0 when the file has no lines.
    pub line: u32,
    /// Column from 1, in bytes (of XML that is not well-formed, in characters); 0 when the whole line is meant, or the file has no lines.
    #[serde(default)]
    pub column: u32,
}

impl Place {
    /// A whole file.
    pub fn file(path: impl Into<PathBuf>) -> Self {
        Place::line(path, 0)
    }
    /// A whole line.
    pub fn line(path: impl Into<PathBuf>, line: u32) -> Self {
        Place { file: path.into(), line, column: 0 }
    }
    /// Where in its line something begins, `at` bytes after its start.
    pub fn at(self, at: usize) -> Self {
        Place { column: u32::try_from(at + 1).unwrap_or(0), ..self }
    }
}

impl std::fmt::Display for Place {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let file = self.file.display();
        match (self.line, self.column) {
            (0, _) => write!(f, "{file}"),
            (line, 0) => write!(f, "{file}:{line}"),
            (line, column) => write!(f, "{file}:{line}:{column}"),
        }
    }
}

/// An affine map, rows of a 3 x 4 matrix: `p' = m[..][0..3] p + m[..][3]`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Affine(pub [[f64; 4]; 3]);

impl Affine {
    /// The map that changes nothing.
    pub const IDENTITY: Affine = Affine([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);

    /// Image of a point.
    pub fn point(&self, p: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|r| self.0[r][0] * p[0] + self.0[r][1] * p[1] + self.0[r][2] * p[2] + self.0[r][3])
    }
    /// Image of a direction (no translation).
    pub fn vector(&self, p: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|r| self.0[r][0] * p[0] + self.0[r][1] * p[1] + self.0[r][2] * p[2])
    }
    /// `self` after `first`.
    pub fn after(&self, first: &Affine) -> Affine {
        Affine(std::array::from_fn(|r| {
            std::array::from_fn(|c| {
                let s = (0..3).map(|k| self.0[r][k] * first.0[k][c]).sum::<f64>();
                if c == 3 { s + self.0[r][3] } else { s }
            })
        }))
    }
    /// Determinant of the linear part; negative for a mirroring map.
    pub fn determinant(&self) -> f64 {
        let m = &self.0;
        m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
            + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
    }
}

/// How one shape's geometry is had.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Geometry {
    /// A mesh file; `format` is decided by the importer.
    MeshFile {
        /// The file.
        path: PathBuf,
        /// Its format.
        format: MeshFormat,
        /// Texture coordinate v becomes 1 - v.
        flip_v: bool,
        /// Where the file has no normals, smooth ones are computed (unless [`Shape::face_normals`]).
        smooth: bool,
        /// What of the file's other properties is read as the mesh's attribute.
        attribute: Option<MeshAttribute>,
        /// What its `usemtl` statements mean (OBJ); they mean nothing if `None`.
        parts: Option<Parts>,
    },
    /// Part of the mesh file of a shape before it, by [`Parts`]: its triangles come with that file's.
    Part,
    /// Triangles given in the description itself (rectangle, cube, disk, cylinder). Object space.
    Inline {
        /// Vertices.
        positions: Vec<[f64; 3]>,
        /// Shading normals by vertex; empty if there are none.
        normals: Vec<[f32; 3]>,
        /// Texture coordinates by vertex; empty if there are none.
        uv: Vec<[f32; 2]>,
        /// Triangles, counter-clockwise from the front.
        triangles: Vec<[u32; 3]>,
    },
    /// An exact sphere in object space (the transform must be a similarity).
    Sphere {
        /// Centre.
        center: [f64; 3],
        /// Radius, above 0.
        radius: f64,
    },
    /// The surface where a volume passes through a value, by marching cubes.
    IsoSurface {
        /// DICOM folder, NRRD/NHDR or NIfTI file.
        path: PathBuf,
        /// The value, in the volume's rescaled units (HU for CT).
        iso: f64,
    },
}

/// A property of a mesh's vertices or faces, of three numbers or of one that stands for three.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct MeshAttribute {
    /// Of faces, not of vertices.
    pub of_faces: bool,
    /// Its name: `color` for `r g b` and `red green blue`, else what stands before `_x _y _z`.
    pub name: String,
    /// Whole numbers are sRGB, their largest value being 1; else they are taken as they are.
    pub srgb: bool,
}

/// The materials that an OBJ file names.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Parts {
    /// Names that `usemtl` may give, each once: the n-th (from 0) is that of the shape n + 1 places after the file's own.
    pub names: Vec<String>,
    /// What the `mtllib` statements say that were read.
    pub libraries: Vec<String>,
    /// Triangles of a name that is not there get the file's own shape; else such a name is an error.
    pub lenient: bool,
}

/// Mesh file formats.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum MeshFormat {
    /// Stanford PLY: ascii, little or big endian, polygons fanned.
    Ply,
    /// Wavefront OBJ, polygons fanned.
    Obj,
    /// STL, ascii or binary.
    Stl,
    /// Mitsuba's `serialized`: the mesh of this number in the file, from 0.
    Serialized(u32),
}

/// One shape: geometry, place, look, light.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Shape {
    /// Name in the source (id or file name), for reports.
    pub name: String,
    /// Where the source defines it.
    pub place: Place,
    /// Its geometry.
    pub geometry: Geometry,
    /// Object space to world space.
    pub to_world: Affine,
    /// Index into [`Description::materials`].
    pub material: u32,
    /// Radiance emitted from the front side (W/sr/m2, linear RGB), if any.
    pub emission: Option<[f32; 3]>,
    /// Index into [`Description::textures`] of what that is multiplied by.
    pub emission_texture: Option<u32>,
    /// Front and back exchanged.
    pub flip_normals: bool,
    /// Shading normals of the file are not used.
    pub face_normals: bool,
}

/// A texture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Texture {
    /// Where the source defines it.
    pub place: Place,
    /// What it is.
    pub kind: TextureKind,
}

/// Kinds of textures.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum TextureKind {
    /// An image file.
    Image {
        /// The file.
        path: PathBuf,
        /// Its bytes are numbers as they are, not sRGB.
        raw: bool,
        /// Beyond the image.
        wrap: Wrap,
        /// Between texels.
        filter: TexelFilter,
        /// Texture coordinates to those of the image.
        to_uv: UvMap,
    },
    /// Squares of two colours.
    Checkerboard(Checkerboard),
    /// The attribute of the mesh that it is on.
    Attribute {
        /// Its name in the source.
        name: String,
        /// What it is multiplied by.
        scale: f32,
    },
}

/// A camera in world space.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Camera to world: the camera looks along +z, +y is up, and +x is to the LEFT of the image (Mitsuba's convention).
    pub to_world: Affine,
    /// Pinhole, lens or parallel.
    pub projection: Projection,
    /// The film's size in pixels and the part of it that is the picture (x, y, width, height); all of it, in any size, if `None`.
    pub crop: Option<([u32; 2], [u32; 4])>,
}

impl Camera {
    /// A pinhole camera with its full field of view along x, degrees, in (0, 180).
    pub fn perspective(to_world: Affine, fov_x: f64) -> Camera {
        Camera { to_world, projection: Projection::Perspective { fov_x }, crop: None }
    }
}

/// Light that arrives at a point from one direction only. World space.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Beam {
    /// A point that shines alike all around.
    Point {
        /// Where it is.
        position: [f64; 3],
        /// W/sr, linear RGB.
        intensity: [f32; 3],
    },
    /// A point that shines into a cone.
    Spot {
        /// Where it is.
        position: [f64; 3],
        /// Unit vector along the cone's middle.
        axis: [f64; 3],
        /// In the inner cone, W/sr, linear RGB.
        intensity: [f32; 3],
        /// Half angle of the inner cone, degrees, below `cutoff`.
        beam: f64,
        /// Half angle of the cone, degrees, at most 180; between the two the intensity falls linearly with the angle.
        cutoff: f64,
        /// A picture that it throws.
        slide: Option<Slide>,
    },
    /// Parallel light from infinitely far away.
    Directional {
        /// Unit vector along which it travels.
        direction: [f64; 3],
        /// On a surface that faces it, W/m2, linear RGB.
        irradiance: [f32; 3],
    },
}

/// A texture in front of a spot light; its borders lie on the cone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Slide {
    /// Index into [`Description::textures`].
    pub texture: u32,
    /// Rows of the map from directions of the world to the light's, whose z axis is the cone's.
    pub to_local: [[f64; 3]; 3],
}

/// Light from infinitely far away, all around.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Environment {
    /// This radiance from everywhere.
    Constant([f32; 3]),
    /// A picture by latitude and longitude: see [`rayherd_render::light::SkyMap`].
    Map {
        /// PNG, JPEG, OpenEXR or Radiance HDR.
        path: PathBuf,
        /// Where the source names it.
        place: Place,
        /// What its values are multiplied by, above 0.
        scale: f32,
        /// Turns directions of the picture to the world's: rotation, mirroring and even scaling only; the latter changes nothing.
        to_world: Affine,
    },
    /// A clear sky.
    Sky(Skylight),
}

/// A clear sky over the horizon of a flat world, dark below: the model of Hosek and Wilkie. In its own directions z is up.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Skylight {
    /// Haze, from 1 (none) to 10.
    pub turbidity: f64,
    /// Albedo of the ground, linear RGB in [0, 1].
    pub albedo: [f64; 3],
    /// Unit vector towards the sun, in the sky's directions; z is not negative.
    pub sun: [f64; 3],
    /// What radiances are multiplied by, above 0.
    pub scale: f32,
    /// Turns the sky's directions to the world's: rotation, mirroring and even scaling only; the latter changes nothing.
    pub to_world: Affine,
}

/// A disk that shines from infinitely far away. World space.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sun {
    /// Unit vector towards its middle.
    pub direction: [f64; 3],
    /// Unit vector upwards: what of the disk lies below the horizon is not seen.
    pub up: [f64; 3],
    /// Half of the angle that it fills, radians, in (0, pi / 2).
    pub half_angle: f64,
    /// W/sr/m2, linear RGB.
    pub radiance: [f32; 3],
}

/// Everything that a source says.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Description {
    /// In source order: the order of records.
    pub shapes: Vec<Shape>,
    /// What shapes refer to.
    pub materials: Vec<Material>,
    /// What materials refer to.
    pub textures: Vec<Texture>,
    /// Point lights, spot lights, parallel light.
    pub beams: Vec<Beam>,
    /// The sky, if any.
    pub environment: Option<Environment>,
    /// The sun, if any.
    pub sun: Option<Sun>,
    /// The camera, if the source has one.
    pub camera: Option<Camera>,
    /// Width and height in pixels, if given.
    pub size: Option<[u32; 2]>,
    /// Pixel filter, if given.
    pub filter: Option<Filter>,
    /// Samples per pixel, if given.
    pub spp: Option<u32>,
    /// Largest number of rays in a path but the shadow rays (Mitsuba's max_depth; 1 sees emitters only), if bounded.
    pub max_depth: Option<u32>,
    /// Vertex from which Russian roulette starts, if given.
    pub rr_depth: Option<u32>,
    /// The camera sees neither what emits light nor the sky; both are seen in reflections.
    pub hide_emitters: bool,
    /// What is to be taken beside light, if the source says it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub aovs: Option<Aovs>,
    /// What was replaced by a stand-in on request, for log and report.
    pub substitutions: Vec<Substitution>,
    /// What was passed over because it says nothing that is computed here, or was read in a way that is not the only one.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub notes: Vec<Note>,
    /// World-space bounds of all primitives, if importing had to find them (to frame a scene without a camera).
    pub bounds: Option<[[f64; 3]; 2]>,
    /// Bytes of the source that importing itself read.
    pub bytes_read: u64,
    /// Passes over all shapes that importing itself made: one if it had to find the bounds by reading, else none.
    pub passes: u32,
}

/// Something that who brings a scene should know, and that is no error.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Note {
    /// Where it stands.
    pub place: Place,
    /// What was done.
    pub text: String,
}

/// Something unsupported that was replaced on request (`--substitute`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Substitution {
    /// Where it stands.
    pub place: Place,
    /// What it is, as the source calls it.
    pub what: String,
    /// What stands in.
    pub stand_in: String,
}
