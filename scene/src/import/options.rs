//! What the caller decides about an import, and how it is written on a command line or in a job file.

use std::str::FromStr;

use super::shapes;
use super::vector::{cross, look_at, normalize, sub};
use crate::description::{Affine, Camera, Place, Shape, Substitution};

/// What the caller decides about an import.
#[derive(Clone, Debug, Default)]
pub struct ImportOptions {
    /// Unsupported elements are replaced by named stand-ins instead of being an error.
    pub substitute: bool,
    /// Values of a Mitsuba scene's `$names`; they win over its defaults. A name that the scene lacks is an error.
    pub defines: Vec<(String, String)>,
    /// Width and height instead of the source's; a field of view along y follows it.
    pub size: Option<[u32; 2]>,
    /// Value of the surface to extract from a volume.
    pub iso: Option<f64>,
    /// Reflectance of a mesh or volume, in [0, 1], instead of [`DEFAULT_ALBEDO`]; an error for an XML scene, which has its own.
    pub albedo: Option<[f32; 3]>,
    /// The camera, instead of the source's or the one that frames it.
    pub camera: Option<CameraView>,
    /// Lights: for a mesh or volume instead of the two that frame it, for an XML scene beside its own.
    pub lights: Vec<Light>,
    /// Radiance of a constant sky, instead of the source's; 0 is no sky.
    pub sky: Option<[f32; 3]>,
}

impl ImportOptions {
    /// Notes something unsupported by its place and what it is, or its stand-in where stand-ins are allowed.
    pub(super) fn note_unsupported(
        &self,
        (place, what): (Place, String),
        stand_in: &str,
        substitutions: &mut Vec<Substitution>,
        unsupported: &mut Vec<(Place, String)>,
    ) {
        if self.substitute {
            substitutions.push(Substitution { place, what, stand_in: stand_in.into() });
        } else {
            unsupported.push((place, what));
        }
    }
}

/// Reflectance of meshes and volumes.
pub const DEFAULT_ALBEDO: [f32; 3] = [0.7; 3];

/// Something that was written wrongly in an option; says how it is written.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct OptionError(String);

/// A camera by origin, target, up and field of view: 10 numbers with commas.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraView {
    /// Where it stands.
    pub origin: [f64; 3],
    /// What it looks at.
    pub target: [f64; 3],
    /// What is up in the image.
    pub up: [f64; 3],
    /// Full field of view along the width, degrees, in (0, 180).
    pub fov: f64,
}

/// A rectangle that shines from `origin` towards `target`: 9 or 11 numbers with commas.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Light {
    /// Its centre.
    pub origin: [f64; 3],
    /// Where its front looks.
    pub target: [f64; 3],
    /// Width and height, above 0.
    pub size: [f64; 2],
    /// Radiance (W/sr/m2, linear RGB).
    pub radiance: [f32; 3],
}

impl CameraView {
    /// Checks and converts.
    pub fn camera(&self) -> Result<Camera, OptionError> {
        let numbers = self.origin.iter().chain(&self.target).chain(&self.up);
        if numbers.chain([&self.fov]).any(|x| !x.is_finite()) {
            return Err(OptionError("the camera has a number that is not finite".into()));
        }
        if !(self.fov > 0.0 && self.fov < 180.0) {
            return Err(OptionError(format!(
                "the camera's field of view {} should lie between 0 and 180 degrees",
                self.fov
            )));
        }
        match look_at(self.origin, self.target, self.up) {
            Some(to_world) => Ok(Camera::perspective(to_world, self.fov)),
            None if self.origin == self.target => {
                Err(OptionError("the camera's origin and target are one point".into()))
            }
            None => Err(OptionError("the camera's up lies along its view: choose another up".into())),
        }
    }
}

impl FromStr for CameraView {
    type Err = OptionError;

    /// `ox,oy,oz,tx,ty,tz,ux,uy,uz,fov`.
    fn from_str(text: &str) -> Result<Self, OptionError> {
        const FORM: &str = "a camera is origin,target,up,fov: ten numbers, as 0,0,4,0,0,0,0,1,0,40";
        let v = numbers(text, FORM)?;
        let [a, b, c, d, e, f, g, h, i, fov] = v[..] else {
            return Err(OptionError(format!("{} numbers in \"{text}\"; {FORM}", v.len())));
        };
        let view = CameraView { origin: [a, b, c], target: [d, e, f], up: [g, h, i], fov };
        view.camera()?;
        Ok(view)
    }
}

impl Light {
    /// As a shape with the material of this number.
    pub(super) fn shape(&self, name: String, material: u32) -> Option<Shape> {
        let forward = normalize(sub(self.target, self.origin))?;
        // width is level where that means something: up is +y, or +x for a light that looks along y
        let up = if cross([0.0, 1.0, 0.0], forward).iter().all(|x| x.abs() < 1e-3) {
            [1.0, 0.0, 0.0]
        } else {
            [0.0, 1.0, 0.0]
        };
        let frame = look_at(self.origin, self.target, up)?;
        let [w, h] = self.size;
        let scale = Affine([[w / 2.0, 0.0, 0.0, 0.0], [0.0, h / 2.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);
        Some(Shape {
            name,
            place: Place::default(),
            geometry: shapes::rectangle(),
            to_world: frame.after(&scale),
            material,
            emission: Some(self.radiance).filter(|rgb| rgb.iter().any(|v| *v > 0.0)),
            emission_texture: None,
            flip_normals: false,
            face_normals: true,
        })
    }
}

impl FromStr for Light {
    type Err = OptionError;

    /// `ox,oy,oz,tx,ty,tz,width,height,r,g,b`, or one radiance for all three.
    fn from_str(text: &str) -> Result<Self, OptionError> {
        const FORM: &str = "a light is origin,target,width,height,radiance: nine numbers (grey) or eleven (red, green, blue), as \
                            2,3,2,0,0,0,1,1,10";
        let v = numbers(text, FORM)?;
        let (a, b, c, d, e, f, w, h, rgb) = match v[..] {
            [a, b, c, d, e, f, w, h, grey] => (a, b, c, d, e, f, w, h, [grey; 3]),
            [a, b, c, d, e, f, w, h, red, green, blue] => (a, b, c, d, e, f, w, h, [red, green, blue]),
            _ => return Err(OptionError(format!("{} numbers in \"{text}\"; {FORM}", v.len()))),
        };
        if !(w > 0.0 && h > 0.0) {
            return Err(OptionError(format!("the light's width and height {w}, {h} should be above 0")));
        }
        if [a, b, c] == [d, e, f] {
            return Err(OptionError("the light's origin and target are one point".into()));
        }
        Ok(Light { origin: [a, b, c], target: [d, e, f], size: [w, h], radiance: radiance(rgb)? })
    }
}

/// Radiance of a sky: one number (grey) or three (linear RGB), at least 0.
pub fn parse_radiance(text: &str) -> Result<[f32; 3], OptionError> {
    radiance(color(text, "a sky is one number (grey) or three (red,green,blue)")?)
}

/// A reflectance: one number (grey) or three (linear RGB) in [0, 1].
pub fn parse_albedo(text: &str) -> Result<[f32; 3], OptionError> {
    let rgb = color(text, "an albedo is one number (grey) or three (red,green,blue)")?;
    if rgb.iter().any(|v| !(0.0..=1.0).contains(v)) {
        return Err(OptionError(format!("the albedo {text} should lie between 0 and 1")));
    }
    Ok(rgb.map(|v| v as f32))
}

/// `name=value`, as `-D` takes it.
pub fn parse_define(text: &str) -> Result<(String, String), OptionError> {
    match text.split_once('=') {
        Some((name, value)) if !name.is_empty() => Ok((name.into(), value.into())),
        _ => Err(OptionError(format!("\"{text}\" is no definition of the form NAME=VALUE"))),
    }
}

fn radiance(rgb: [f64; 3]) -> Result<[f32; 3], OptionError> {
    if rgb.iter().any(|v| *v < 0.0 || *v > f64::from(f32::MAX)) {
        return Err(OptionError(format!("the radiance {rgb:?} should be at least 0 and fit a float")));
    }
    Ok(rgb.map(|v| v as f32))
}

fn color(text: &str, form: &str) -> Result<[f64; 3], OptionError> {
    match numbers(text, form)?[..] {
        [v] => Ok([v; 3]),
        [r, g, b] => Ok([r, g, b]),
        ref other => Err(OptionError(format!("{} numbers in \"{text}\"; {form}", other.len()))),
    }
}

fn numbers(text: &str, form: &str) -> Result<Vec<f64>, OptionError> {
    text.split(|c: char| c == ',' || c.is_whitespace())
        .filter(|word| !word.is_empty())
        .map(|word| match word.parse::<f64>() {
            Ok(x) if x.is_finite() => Ok(x),
            _ => Err(OptionError(format!("\"{word}\" is no finite number; {form}"))),
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::Projection;

    #[test]
    fn a_camera_is_ten_numbers() {
        let view: CameraView = "0,0,4, 0,0,0, 0,1,0, 40".parse().unwrap();
        let camera = view.camera().unwrap();
        assert_eq!(camera.projection, Projection::Perspective { fov_x: 40.0 });
        assert_eq!(camera.to_world.vector([0.0, 0.0, 1.0]), [0.0, 0.0, -1.0]);
        for (text, what) in [
            ("1,2,3", "3 numbers"),
            ("0,0,4,0,0,0,0,1,0,x", "no finite number"),
            ("0,0,4,0,0,0,0,1,0,nan", "no finite number"),
            ("0,0,4,0,0,0,0,1,0,180", "between 0 and 180"),
            ("0,0,4,0,0,4,0,1,0,40", "one point"),
            ("0,0,4,0,0,0,0,0,1,40", "along its view"),
        ] {
            let error = text.parse::<CameraView>().unwrap_err().to_string();
            assert!(error.contains(what), "{text}: {error}");
        }
    }

    #[test]
    fn a_light_faces_its_target() {
        for text in ["0,5,0,0,0,0,2,4,10", "1,2,3,0,0,0,2,4,10,11,12"] {
            let light: Light = text.parse().unwrap();
            let shape = light.shape("l".into(), 0).unwrap();
            let front = shape.to_world.vector([0.0, 0.0, 1.0]);
            let towards = normalize(sub(light.target, light.origin)).unwrap();
            for k in 0..3 {
                assert!((front[k] - towards[k]).abs() < 1e-12);
            }
            // |x edge| x |y edge| is a quarter of the area
            assert!((shape.to_world.determinant() - 2.0).abs() < 1e-12);
        }
        assert!("0,5,0,0,0,0,2,0,10".parse::<Light>().unwrap_err().to_string().contains("above 0"));
        assert!("0,5,0,0,0,0,2,1,-1".parse::<Light>().unwrap_err().to_string().contains("at least 0"));
        assert!("0,5,0,0,0,0,2,1".parse::<Light>().unwrap_err().to_string().contains("8 numbers"));
    }

    #[test]
    fn colours_and_definitions() {
        assert_eq!(parse_radiance("2").unwrap(), [2.0; 3]);
        assert_eq!(parse_radiance("1, 2 ,3").unwrap(), [1.0, 2.0, 3.0]);
        assert!(parse_radiance("1,2").is_err());
        assert!(parse_albedo("1.5").unwrap_err().to_string().contains("between 0 and 1"));
        assert_eq!(parse_define("spp=4=x").unwrap(), ("spp".into(), "4=x".into()));
        assert!(parse_define("=4").is_err());
    }
}
