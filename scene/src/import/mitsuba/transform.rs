//! The steps of a `<transform>`.

use super::value;
use super::xml::malformed;
use crate::ImportError;
use crate::description::{Affine, Place};
use crate::import::vector::{cross, dot, look_at, normalize};

/// The map of one element inside `<transform>`; each is applied after those above it.
pub(super) fn step<'a>(tag: &str, get: &dyn Fn(&str) -> Option<&'a str>, place: &Place) -> Result<Affine, ImportError> {
    let need = |name: &str| match get(name) {
        Some(text) => Ok(text),
        None => malformed(place, format!("<{tag}> lacks its attribute \"{name}\"")),
    };
    match tag {
        "translate" => {
            let [x, y, z] = value::vector(get, 0.0, place)?;
            Ok(Affine([[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, y], [0.0, 0.0, 1.0, z]]))
        }
        "scale" => {
            let [x, y, z] = value::vector(get, 1.0, place)?;
            Ok(Affine([[x, 0.0, 0.0, 0.0], [0.0, y, 0.0, 0.0], [0.0, 0.0, z, 0.0]]))
        }
        "rotate" => {
            let axis = value::vector(get, 0.0, place)?;
            let angle = value::float(need("angle")?, place)?;
            match normalize(axis) {
                Some(axis) => Ok(rotation(axis, angle)),
                None => malformed(place, "the axis of a rotation is zero"),
            }
        }
        "lookat" | "lookAt" | "look_at" => {
            let point = |name: &str| match value::floats(need(name)?, place)?[..] {
                [x, y, z] => Ok([x, y, z]),
                _ => malformed(place, format!("\"{name}\" of <{tag}> needs three numbers")),
            };
            let (origin, target) = (point("origin")?, point("target")?);
            let mut up = if get("up").is_some() { point("up")? } else { [0.0; 3] };
            if up == [0.0; 3] {
                up = any_normal([0, 1, 2].map(|i| target[i] - origin[i]));
            }
            match look_at(origin, target, up) {
                Some(map) => Ok(map),
                None => malformed(place, "origin and target are one point, or up lies along the view"),
            }
        }
        "matrix" => {
            let v = value::floats(need("value")?, place)?;
            let n = match v.len() {
                9 => 3,
                16 => 4,
                n => return malformed(place, format!("a matrix has 9 or 16 numbers, not {n}")),
            };
            if n == 4 && v[12..] != [0.0, 0.0, 0.0, 1.0] {
                return malformed(
                    place,
                    "the last row of a matrix must be 0 0 0 1 (projective maps are not supported)",
                );
            }
            let mut m = Affine::IDENTITY;
            for r in 0..3 {
                m.0[r][..n].copy_from_slice(&v[r * n..r * n + n]);
            }
            Ok(m)
        }
        _ => malformed(
            place,
            format!("<{tag}> inside <transform>: only translate, rotate, scale, matrix and lookat go there"),
        ),
    }
}

/// Rotation about a unit axis by an angle in degrees, counter-clockwise seen against the axis (Rodrigues).
fn rotation(a: [f64; 3], degrees: f64) -> Affine {
    let (s, c) = libm::sincos(degrees.to_radians());
    let t = 1.0 - c;
    Affine([
        [a[0] * a[0] * t + c, a[0] * a[1] * t - a[2] * s, a[0] * a[2] * t + a[1] * s, 0.0],
        [a[1] * a[0] * t + a[2] * s, a[1] * a[1] * t + c, a[1] * a[2] * t - a[0] * s, 0.0],
        [a[2] * a[0] * t - a[1] * s, a[2] * a[1] * t + a[0] * s, a[2] * a[2] * t + c, 0.0],
    ])
}

/// Some direction at right angles to `d`: the axis that `d` is farthest from, made orthogonal.
fn any_normal(d: [f64; 3]) -> [f64; 3] {
    let axis = (0..3).min_by(|&a, &b| d[a].abs().total_cmp(&d[b].abs())).unwrap_or(1);
    let mut up = [0.0; 3];
    up[axis] = 1.0;
    let along = dot(up, d);
    let length2 = dot(d, d);
    if length2 > 0.0 { [0, 1, 2].map(|i| up[i] - d[i] * along / length2) } else { cross(up, d) }
}
