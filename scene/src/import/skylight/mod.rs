//! The clear sky and the sun by Hosek and Wilkie, as Mitsuba 3's `sunsky` evaluates them in RGB.
//!
//! Hosek and Wilkie 2012, "An Analytic Model for Full Spectral Sky-Dome Radiance" (equation 8), and 2013, "Adding a Solar-Radiance Function to the
//! Hosek-Wilkie Skylight Model"; the fitted numbers in `tables.bin` are theirs, under the licence beside it (`tables.py` made it). Directions are
//! the model's own: z is up. Radiances are Mitsuba's, its weights of the sun's wavelengths included; the sun is an even disk (no `complex_sun`).

mod position;
#[cfg(test)]
mod tests;

use std::f64::consts::{FRAC_PI_2, PI};

use rayherd_render::light::SkyMap;

pub(super) use position::{Moment, zenith_and_azimuth};

use super::vector::dot;
use crate::description::{Affine, Skylight};

/// Columns and rows of a sky's picture. Between rows (0.18 degrees) radiance is interpolated, which takes at most 0.02 % from the whole; within a row of
/// the horizon, where the model has a root of the height, up to 4 % (of a sun on the horizon 10 %).
const SIZE: [u32; 2] = [1024, 1025];

const TURBIDITIES: usize = 10;
const CONTROL_POINTS: usize = 6;
const ELEVATIONS: usize = 30;
const PARAMETERS: usize = 9;
/// One over the integral of CIE's y, which turns the model's tristimulus values to Mitsuba's units.
const PER_CIE_Y: f64 = 1.0 / 106.750_259_399_414_06;
/// What Mitsuba multiplies the sun's irradiance by.
const SUN_TO_RGB: f64 = 467.069_280_386;

/// `tables.bin`: parameters, radiances and the sun's irradiance, as `tables.py` says.
static TABLES: &[u8] = include_bytes!("tables.bin");
const RADIANCES: usize = TURBIDITIES * 2 * CONTROL_POINTS * 3 * PARAMETERS;
const IRRADIANCES: usize = RADIANCES + TURBIDITIES * 2 * CONTROL_POINTS * 3;
const _: () = assert!(TABLES.len() == 4 * (IRRADIANCES + TURBIDITIES * ELEVATIONS * 3));

fn table(i: usize) -> f64 {
    f64::from(f32::from_le_bytes([TABLES[4 * i], TABLES[4 * i + 1], TABLES[4 * i + 2], TABLES[4 * i + 3]]))
}

/// The place of `x` between the entries of a table of `n`: the one below, and the share of the one above.
fn between(x: f64, n: usize) -> (usize, f64) {
    let x = x.clamp(0.0, (n - 1) as f64);
    let i = (x as usize).min(n - 2);
    (i, x - i as f64)
}

/// The sky's radiance for one sun, air and ground.
struct Dome {
    /// By channel.
    parameters: [[f64; PARAMETERS]; 3],
    radiance: [f64; 3],
    sun: [f64; 3],
}

impl Dome {
    fn new(sky: &Skylight) -> Dome {
        let elevation = FRAC_PI_2 - libm::acos(sky.sun[2].clamp(-1.0, 1.0));
        // control points are denser where the sun is low
        let x = libm::cbrt(elevation.max(0.0) / FRAC_PI_2).min(1.0);
        let bezier: [f64; CONTROL_POINTS] = std::array::from_fn(|k| {
            let power = |base: f64, n: usize| (0..n).fold(1.0, |product, _| product * base);
            [1.0, 5.0, 10.0, 10.0, 5.0, 1.0][k] * power(x, k) * power(1.0 - x, CONTROL_POINTS - 1 - k)
        });
        let (low, up) = between(sky.turbidity - 1.0, TURBIDITIES);
        let mixed = |start: usize, width: usize, channel: usize, number: usize| {
            let albedo = sky.albedo[channel];
            let mut sum = 0.0;
            for (turbidity, by_turbidity) in [(low, 1.0 - up), (low + 1, up)] {
                for (ground, by_albedo) in [1.0 - albedo, albedo].into_iter().enumerate() {
                    for (k, by_elevation) in bezier.into_iter().enumerate() {
                        let row = ((turbidity * 2 + ground) * CONTROL_POINTS + k) * 3 + channel;
                        sum += by_turbidity * by_albedo * by_elevation * table(start + row * width + number);
                    }
                }
            }
            sum
        };
        Dome {
            parameters: std::array::from_fn(|c| std::array::from_fn(|n| mixed(0, PARAMETERS, c, n))),
            radiance: std::array::from_fn(|c| mixed(RADIANCES, 1, c, 0)),
            sun: sky.sun,
        }
    }

    /// Radiance from a unit direction above the horizon. Where the model's RGB fit falls below 0 (thick air at dusk), 0.
    fn radiance(&self, d: [f64; 3]) -> [f64; 3] {
        let height = d[2].max(0.0);
        let cos = dot(d, self.sun).clamp(-1.0, 1.0);
        let angle = libm::acos(cos);
        std::array::from_fn(|c| {
            let [a, b, constant, e, f, square, bright, root, g] = self.parameters[c];
            let horizon = 1.0 + a * libm::exp(b / (height + 0.01));
            let chi = (1.0 + cos * cos) / libm::pow(1.0 + g * g - 2.0 * g * cos, 1.5);
            let glow = constant + e * libm::exp(f * angle) + square * cos * cos + bright * chi + root * height.sqrt();
            (horizon * glow * self.radiance[c] * PER_CIE_Y).max(0.0)
        })
    }
}

/// Turns directions of a sky's picture, where y is up, to the model's.
pub(crate) const PICTURE_TO_SKY: Affine = Affine([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0]]);

/// The picture of a sky, its `scale` aside: the lower half is dark.
pub(super) fn picture(sky: &Skylight) -> SkyMap {
    let dome = Dome::new(sky);
    let [width, height] = SIZE;
    let horizon = height / 2;
    let mut texels = vec![[0.0f32; 3]; (width * height) as usize];
    for (row, texels) in texels.chunks_exact_mut(width as usize).take(horizon as usize + 1).enumerate() {
        let from_top = PI * row as f64 / f64::from(height - 1);
        let (sin, up) = (libm::sin(from_top), libm::cos(from_top));
        for (column, texel) in texels.iter_mut().enumerate() {
            let turn = 2.0 * PI * (column as f64 + 0.5) / f64::from(width);
            // the picture's x and -z; the sky's y is the picture's -z
            let d = [sin * libm::sin(turn), sin * libm::cos(turn), up];
            *texel = dome.radiance(d).map(|v| v as f32);
        }
    }
    match SkyMap::new(width, height, texels) {
        Ok(map) => map,
        Err(error) => unreachable!("finite radiances, not below 0: {error}"),
    }
}

/// Irradiance, in Mitsuba's units, of the sun on a surface that faces it; 0 below the horizon. `height` is the sine of its elevation.
pub(super) fn sun_irradiance(turbidity: f64, height: f64) -> [f64; 3] {
    if height.is_nan() || height < 0.0 {
        return [0.0; 3];
    }
    let elevation = (FRAC_PI_2 - libm::acos(height.min(1.0))).to_degrees();
    let (low, up) = between(turbidity - 1.0, TURBIDITIES);
    let (below, above) = between((elevation - 2.0) / 3.0, ELEVATIONS);
    std::array::from_fn(|c| {
        let at = |t: usize, e: usize| table(IRRADIANCES + (t * ELEVATIONS + e) * 3 + c);
        let row = |t: usize| at(t, below) * (1.0 - above) + at(t, below + 1) * above;
        ((row(low) * (1.0 - up) + row(low + 1) * up) * SUN_TO_RGB).max(0.0)
    })
}
