//! What is seen where nothing is met: a dome of light, and a sun in it.
//!
//! Both are one source: a sample is one of the sun's with a fixed probability, a multiple of 2^-32, else one of the dome's, and a direction's density is
//! that of both together.

use std::sync::Arc;

use super::map::Place;
use super::picture::{Directions, MANY, Picture, snapped};
use super::sun::Sun;
use super::{SkyMap, sphere, wide};
use crate::math::{luminance, unit};
use crate::real::{Vec3, f32};
use crate::world::{Environment, World};

/// All numbers that choose between sun and dome.
const WHOLE: u64 = 1 << 32;
/// Neither sun nor dome is chosen less often than this where there are both: whichever is the brighter may be out of sight.
const LEAST: f64 = 0.125;

/// The light that comes from infinitely far away, all around.
#[derive(Clone, Debug)]
pub(super) struct Sky {
    dome: Dome,
    sun: Option<Sun>,
    /// Numbers below this choose the sun.
    sun_end: u64,
}

/// The sky without the sun.
#[derive(Clone, Debug)]
enum Dome {
    /// None.
    None,
    /// The same from everywhere, sampled evenly.
    Constant(Vec3),
    /// A picture.
    Map(Picture),
}

impl Sky {
    pub(super) fn new(world: &World, map: Option<Arc<SkyMap>>) -> Sky {
        let dome = Dome::new(world.environment.as_ref(), map);
        let sun = world.sun.as_ref().and_then(Sun::new);
        let light = |mean: Option<Vec3>| mean.map_or(0.0, |m| f64::from(luminance(m)));
        let (of_sun, of_dome) = (light(sun.as_ref().map(Sun::mean)), light(dome.mean()));
        let share = match (of_sun > 0.0, of_dome > 0.0) {
            (false, _) => 0.0,
            (true, false) => 1.0,
            (true, true) => (of_sun / (of_sun + of_dome)).clamp(LEAST, 1.0 - LEAST),
        };
        Sky { dome, sun, sun_end: (share * WHOLE as f64) as u64 }
    }

    /// Whether there is none.
    pub(super) fn is_dark(&self) -> bool {
        matches!(self.dome, Dome::None) && self.sun.is_none()
    }

    /// Radiance averaged over all directions, if there is a sky.
    pub(super) fn mean(&self) -> Option<Vec3> {
        match (self.dome.mean(), &self.sun) {
            (dome, Some(sun)) => Some(dome.unwrap_or(Vec3::ZERO) + sun.mean()),
            (dome, None) => dome,
        }
    }

    /// Whether there is a picture, which memory holds and no cache: then many are sampled, or looked up, sooner than one by one.
    pub(super) fn is_far(&self) -> bool {
        matches!(self.dome, Dome::Map(_))
    }

    /// Radiance from a unit direction, and with which density in solid angle [`Sky::sample`] gives it.
    #[inline]
    pub(super) fn look_up(&self, d: Vec3) -> (Vec3, f32) {
        self.look_up_at(d, self.dome.place(d))
    }

    /// [`Sky::look_up`] of many directions, given with their index: all are asked for before the first is read.
    pub(super) fn look_up_many(&self, directions: &[Vec3], mut give: impl FnMut(usize, (Vec3, f32))) {
        let Dome::Map(picture) = &self.dome else {
            directions.iter().enumerate().for_each(|(i, d)| give(i, self.look_up(*d)));
            return;
        };
        let mut many = Directions::new();
        for (k, part) in directions.chunks(MANY).enumerate() {
            part.iter().enumerate().for_each(|(i, d)| many.set(i, *d));
            wide::place(&mut many, picture);
            (0..part.len()).for_each(|i| picture.map.foresee(&many.place_of(i)));
            for (i, d) in part.iter().enumerate() {
                give(k * MANY + i, self.look_up_at(*d, many.place_of(i)));
            }
        }
    }

    #[inline]
    fn look_up_at(&self, d: Vec3, place: Place) -> (Vec3, f32) {
        let of_dome = self.dome.look_up(d, &place);
        let Some(sun) = &self.sun else { return of_dome };
        let of_sun = sun.look_up(d);
        let share = self.sun_end as f32 * (1.0 / WHOLE as f32);
        (of_dome.0 + of_sun.0, of_dome.1 * (1.0 - share) + of_sun.1 * share)
    }

    /// A direction, the radiance from it, its density; `None` where what was chosen is not what the direction, snapped, lies in.
    #[inline]
    pub(super) fn sample(&self, u: [u32; 2]) -> Option<(Vec3, Vec3, f32)> {
        if let (None, Dome::Constant(radiance)) = (&self.sun, &self.dome) {
            let d = sphere::uniform(u.map(unit));
            return Some((d, *radiance, sphere::UNIFORM_PDF));
        }
        let d = match (self.choose(u), &self.sun) {
            ((true, u), Some(sun)) => sun.sample(u.map(unit)),
            ((_, u), _) => self.dome.sample(u)?,
        };
        let (radiance, pdf) = self.look_up(d);
        (pdf > 0.0).then_some((d, radiance, pdf))
    }

    /// [`Sky::sample`] by many pairs of numbers, given with their index: what a step reads is asked for by the step before, for all.
    pub(super) fn sample_many(&self, numbers: &[[u32; 2]], mut give: impl FnMut(usize, Option<(Vec3, Vec3, f32)>)) {
        let Dome::Map(picture) = &self.dome else {
            numbers.iter().enumerate().for_each(|(i, u)| give(i, self.sample(*u)));
            return;
        };
        let mut many = Directions::new();
        let (mut rests, mut cells) = ([[0; 2]; MANY], [Default::default(); MANY]);
        for (k, some) in numbers.chunks(MANY).enumerate() {
            // those of the dome in a list: no branch depends on a number
            let (mut of_dome, mut count) = ([0; MANY], 0);
            for (i, numbers) in some.iter().enumerate() {
                let (is_sun, rest) = self.choose(*numbers);
                rests[i] = rest;
                many.set_sun(i, is_sun, rest);
                // written before it is known whether it counts; the mask changes nothing, and tells the compiler that there is a place
                of_dome[count & (MANY - 1)] = i;
                count += usize::from(!is_sun);
            }
            for &i in &of_dome[..count] {
                cells[i] = picture.map.choose(rests[i]);
            }
            for &i in &of_dome[..count] {
                many.set_spot(i, picture.map.spot(&cells[i], rests[i]));
            }
            wide::turn(&mut many, self);
            wide::place(&mut many, picture);
            (0..some.len()).for_each(|i| picture.map.foresee(&many.place_of(i)));
            for i in 0..some.len() {
                let d = many.get(i);
                let (radiance, pdf) = self.look_up_at(d, many.place_of(i));
                give(k * MANY + i, (pdf > 0.0).then_some((d, radiance, pdf)));
            }
        }
    }

    /// Whether numbers stand for the sun, and numbers for a direction of what they stand for: what is left of the first is as random.
    #[inline(always)]
    fn choose(&self, u: [u32; 2]) -> (bool, [u32; 2]) {
        if self.sun_end == 0 {
            return (false, u);
        }
        let number = u64::from(u[0]);
        let is_sun = number < self.sun_end;
        let (start, count) = if is_sun { (0, self.sun_end) } else { (self.sun_end, WHOLE - self.sun_end) };
        (is_sun, [(((number - start) << 32) / count) as u32, u[1]])
    }
}

impl Directions {
    /// Directions of the spots, and of the sun.
    #[inline(always)]
    pub(super) fn turn(&mut self, sky: &Sky) {
        if let Dome::Map(picture) = &sky.dome {
            self.turn_spots(picture);
        }
        if let Some(sun) = &sky.sun {
            self.turn_to(sun);
        }
    }
}

impl Dome {
    fn new(environment: Option<&Environment>, map: Option<Arc<SkyMap>>) -> Dome {
        match (environment, map) {
            (Some(Environment::Constant(radiance)), _) if luminance(Vec3::from(*radiance)) > 0.0 => {
                Dome::Constant(Vec3::from(*radiance))
            }
            (Some(&Environment::Map { scale, to_map, upper }), Some(map)) if map.shines() && scale > 0.0 => {
                Dome::Map(Picture { map, scale, to_map: to_map.map(Vec3::from), upper })
            }
            _ => Dome::None,
        }
    }

    fn mean(&self) -> Option<Vec3> {
        match self {
            Dome::None => None,
            Dome::Constant(radiance) => Some(*radiance),
            Dome::Map(picture) => Some(picture.mean()),
        }
    }

    /// Where a picture is looked up.
    #[inline]
    fn place(&self, d: Vec3) -> Place {
        match self {
            Dome::Map(picture) => picture.place(d),
            _ => Place::default(),
        }
    }

    /// Of a direction and its place.
    #[inline]
    fn look_up(&self, d: Vec3, place: &Place) -> (Vec3, f32) {
        match self {
            Dome::None => (Vec3::ZERO, 0.0),
            Dome::Constant(radiance) => (*radiance, sphere::UNIFORM_PDF),
            Dome::Map(picture) => picture.look_up(d, place),
        }
    }

    /// A direction as it travels, so that whoever comes upon it finds the same.
    #[inline]
    fn sample(&self, u: [u32; 2]) -> Option<Vec3> {
        match self {
            Dome::None => None,
            Dome::Constant(_) => Some(snapped(sphere::uniform(u.map(unit)))),
            Dome::Map(picture) => Some(picture.sample(u)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Rng;

    /// Every number stands for one part, in order, and what is left of it goes from the least to the most.
    #[test]
    fn what_is_left_of_a_choice_is_as_random() {
        let world = World { environment: Some(Environment::Constant([1.0; 3])), ..World::default() };
        for sun_end in [0, 1, 3, WHOLE / 8, WHOLE - 1, WHOLE] {
            let sky = Sky { sun_end, ..Sky::new(&world, None) };
            for (part, start, end) in [(true, 0, sun_end), (false, sun_end, WHOLE)] {
                let Some(last) = end.checked_sub(1).filter(|last| *last >= start) else { continue };
                assert_eq!(sky.choose([start as u32, 7]), (part, [0, 7]), "{sun_end}");
                let (chosen, [rest, other]) = sky.choose([last as u32, 9]);
                // the last of n numbers stands for the last n-th part
                let most = ((last - start) << 32) / (end - start);
                assert_eq!((chosen, u64::from(rest), other), (part, most, 9), "{sun_end}");
            }
        }
    }

    /// Many at once are what each alone is, whatever the sky and however many.
    #[test]
    fn many_are_each() {
        let mut rng = Rng(31);
        let texels = (0..32 * 17).map(|_| std::array::from_fn(|_| rng.f32().powi(3))).collect();
        let map = Arc::new(SkyMap::new(32, 17, texels).unwrap());
        let to_map = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]];
        let picture = |upper| Some(Environment::Map { scale: 1.5, to_map, upper });
        let sun = crate::world::Sun { direction: [0.0, 0.6, 0.8], up: [0.0; 3], cap: 0.1, radiance: [9.0; 3] };
        for environment in [None, Some(Environment::Constant([1.0, 2.0, 3.0])), picture(false), picture(true)] {
            for sun in [None, Some(sun)] {
                let world = World { environment: environment.clone(), sun, ..World::default() };
                let sky = Sky::new(&world, Some(map.clone()));
                for count in [0, 1, MANY - 1, MANY, 3 * MANY + 5] {
                    let numbers: Vec<[u32; 2]> = (0..count).map(|_| [rng.u32(), rng.u32()]).collect();
                    let mut seen = 0;
                    sky.sample_many(&numbers, |i, sample| {
                        assert_eq!(sample, sky.sample(numbers[i]));
                        seen += 1;
                    });
                    let directions: Vec<Vec3> = (0..count).map(|_| rng.direction()).collect();
                    sky.look_up_many(&directions, |i, found| {
                        assert_eq!(found, sky.look_up(directions[i]));
                        seen += 1;
                    });
                    assert_eq!(seen, 2 * count);
                }
            }
        }
    }
}
