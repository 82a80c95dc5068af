//! A picture of the sky as it stands in the scene: turned, scaled, its lower half dark perhaps.

use std::sync::Arc;

use super::SkyMap;
use super::map::{Place, Spot};
use super::sun::Sun;
use crate::math::{UnitDir, unit};
use crate::real::{Vec3, f32};

/// So many directions are worked at together: as many lines of memory as a processor fetches at a time, about.
pub(super) const MANY: usize = 32;
// places in lists are cut to it by a mask
const _: () = assert!(MANY.is_power_of_two());

/// A picture, turned.
#[derive(Clone, Debug)]
pub(super) struct Picture {
    pub(super) map: Arc<SkyMap>,
    pub(super) scale: f32,
    /// Rows of the rotation from the world's directions to the map's.
    pub(super) to_map: [Vec3; 3],
    /// Its lower half is dark.
    pub(super) upper: bool,
}

impl Picture {
    /// Radiance averaged over all directions.
    pub(super) fn mean(&self) -> Vec3 {
        self.map.mean() * self.scale
    }

    /// Where a direction lies.
    #[inline(always)]
    pub(super) fn place(&self, d: Vec3) -> Place {
        let [x, y, z] = self.to_map;
        self.map.place(Vec3::new(x.dot(d), y.dot(d), z.dot(d)))
    }

    /// Radiance and density of a direction and its place.
    #[inline]
    pub(super) fn look_up(&self, d: Vec3, place: &Place) -> (Vec3, f32) {
        let (radiance, pdf) = self.map.at(place);
        (if self.upper && self.to_map[1].dot(d) < 0.0 { Vec3::ZERO } else { radiance * self.scale }, pdf)
    }

    /// A direction by two numbers, as it travels, so that whoever comes upon it finds the same.
    #[inline]
    pub(super) fn sample(&self, u: [u32; 2]) -> Vec3 {
        self.turned(self.map.spot(&self.map.choose(u), u))
    }

    #[inline(always)]
    fn turned(&self, spot: Spot) -> Vec3 {
        let ([x, y, z], d) = (self.to_map, self.map.direction(spot));
        snapped(x * d.x + y * d.y + z * d.z)
    }
}

/// A direction as it travels.
#[inline(always)]
pub(super) fn snapped(d: Vec3) -> Vec3 {
    Vec3::from(UnitDir::encode(d.to_array()).decode())
}

/// Directions, and what is known of each: by component, so that loops over them become vector code.
#[derive(Clone, Debug)]
pub(super) struct Directions {
    spots: [[f64; MANY]; 2],
    is_sun: [bool; MANY],
    of_sun: [[f32; MANY]; 2],
    directions: [[f32; MANY]; 3],
    patches: [[u32; MANY]; 2],
    within: [[f32; MANY]; 2],
}

impl Directions {
    pub(super) fn new() -> Directions {
        Directions {
            spots: [[0.0; MANY]; 2],
            is_sun: [false; MANY],
            of_sun: [[0.0; MANY]; 2],
            directions: [[0.0; MANY]; 3],
            patches: [[0; MANY]; 2],
            within: [[0.0; MANY]; 2],
        }
    }

    pub(super) fn set_spot(&mut self, i: usize, spot: Spot) {
        [self.spots[0][i], self.spots[1][i]] = [spot.x, spot.cos];
    }

    /// Whether a direction is one of the sun's, and its numbers.
    #[inline(always)]
    pub(super) fn set_sun(&mut self, i: usize, is_sun: bool, numbers: [u32; 2]) {
        self.is_sun[i] = is_sun;
        [self.of_sun[0][i], self.of_sun[1][i]] = [unit(numbers[0]), unit(numbers[1])];
    }

    pub(super) fn set(&mut self, i: usize, d: Vec3) {
        [self.directions[0][i], self.directions[1][i], self.directions[2][i]] = d.to_array();
    }

    pub(super) fn get(&self, i: usize) -> Vec3 {
        Vec3::new(self.directions[0][i], self.directions[1][i], self.directions[2][i])
    }

    pub(super) fn place_of(&self, i: usize) -> Place {
        Place { x: self.patches[0][i], y: self.patches[1][i], fx: self.within[0][i], fy: self.within[1][i] }
    }

    /// Directions of the spots.
    #[inline(always)]
    pub(super) fn turn_spots(&mut self, picture: &Picture) {
        for i in 0..MANY {
            let d = picture.turned(Spot { x: self.spots[0][i], cos: self.spots[1][i] });
            self.directions[0][i] = d.x;
            self.directions[1][i] = d.y;
            self.directions[2][i] = d.z;
        }
    }

    /// Directions of the sun, where they are its.
    #[inline(always)]
    pub(super) fn turn_to(&mut self, sun: &Sun) {
        for i in 0..MANY {
            let d = sun.sample([self.of_sun[0][i], self.of_sun[1][i]]);
            self.directions[0][i] = if self.is_sun[i] { d.x } else { self.directions[0][i] };
            self.directions[1][i] = if self.is_sun[i] { d.y } else { self.directions[1][i] };
            self.directions[2][i] = if self.is_sun[i] { d.z } else { self.directions[2][i] };
        }
    }

    /// Places of the directions.
    #[inline(always)]
    pub(super) fn place(&mut self, picture: &Picture) {
        for i in 0..MANY {
            let place = picture.place(self.get(i));
            self.patches[0][i] = place.x;
            self.patches[1][i] = place.y;
            self.within[0][i] = place.fx;
            self.within[1][i] = place.fy;
        }
    }
}
