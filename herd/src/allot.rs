//! How the samples of a picture that is to reach a target error are shared out among the tiles of its film. Pure.
//!
//! The error of a tile falls with its samples as v / n, and n samples of its p pixels cost n p. For a sum of errors the samples that cost
//! least are n proportional to sqrt(v / p) (J. Neyman, "On the two different aspects of the representative method", 1934, section 5.1).
//! What v is, the film says after each complete step; the first ones are even. Nothing here knows of the target but [`Step::first`],
//! which only says where to stop: a lower target goes on where a higher one has stopped.

use rayherd_render::film::{ErrorSum, PerTile, Samples};
use serde::{Deserialize, Serialize};

use crate::wave::MAX_SPP;

/// Samples that every pixel gets before the errors of tiles are believed.
pub const EVEN: u32 = 16;
/// No tile has less than this part of the mean: an error that was found with few samples may have missed what is rare and bright.
const FLOOR: u32 = 8;
/// Nor does a step give a tile more than so many times what it has.
const GROWTH: u32 = 4;
/// A step is made in so many parts, and the error looked at after each.
const PARTS: u32 = 4;
/// What a step adds to a tile is a multiple of this: each part adds as many even as odd samples.
const GRAIN: u32 = 2 * PARTS;

/// A step of a run with a target error: samples that are added to tiles.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Step {
    /// Samples per pixel at its end, on average: about, as each tile's are rounded.
    pub mean: u32,
    /// What tiles have before it.
    pub from: Samples,
    /// What they have after it.
    pub to: Samples,
    /// Sum of the errors that is expected after each of its parts.
    pub expected: [ErrorSum; PARTS as usize],
}

impl Step {
    /// The step after `from`, to a mean of `mean`, for tiles of so many pixels whose errors these are. Where samples are not `shared` out by error, all tiles
    /// get the same; then they must have the same.
    pub fn plan(errors: &[ErrorSum], from: Samples, pixels: &[u64], mean: u32, shared: bool) -> Step {
        let has: Vec<u32> = (0..pixels.len()).map(|t| from.of_tile(t)).collect();
        let goal: Vec<f64> =
            if shared { share(errors, &has, pixels, mean) } else { vec![f64::from(mean); pixels.len()] };
        let grain = f64::from(GRAIN);
        let rounded = |(n, goal): (&u32, f64)| {
            let more = ((goal - f64::from(*n)).max(0.0) / grain).round() * grain;
            n.saturating_add(more as u32).min(MAX_SPP)
        };
        let mut to: Vec<u32> = has.iter().zip(goal).map(rounded).collect();
        if to == has {
            // what has an error can have no more: on to where nothing can
            to.iter_mut().for_each(|n| *n = n.saturating_add(GRAIN).min(MAX_SPP));
        }
        let mut step = Step { mean, from, to: Samples::of(to), expected: Default::default() };
        step.expected = std::array::from_fn(|part| {
            let then = step.after(part as u32 + 1);
            let error = |(t, n): (usize, &u32)| errors[t].value() * f64::from(*n) / f64::from(then.of_tile(t).max(1));
            ErrorSum::of(has.iter().enumerate().map(error).sum())
        });
        step
    }

    /// What tiles have after so many of its parts: all of it after the last.
    pub fn after(&self, parts: u32) -> Samples {
        self.at(|more| u64::from(more) * u64::from(parts.min(PARTS)) / u64::from(PARTS))
    }

    /// What tiles have after a share of it, from 0 to 1.
    pub fn cut(&self, share: f64) -> Samples {
        self.at(|more| (f64::from(more) * share.clamp(0.0, 1.0)).ceil() as u64)
    }

    fn at(&self, part: impl Fn(u32) -> u64) -> Samples {
        match (&self.from, &self.to) {
            (Samples::Even(a), Samples::Even(b)) => Samples::Even(a + part(b - a) as u32),
            (Samples::Each(tiles), _) | (_, Samples::Each(tiles)) => {
                let ends = (0..tiles.len()).map(|t| (self.from.of_tile(t), self.to.of_tile(t)));
                Samples::of(ends.map(|(a, b)| a + part(b - a) as u32).collect())
            }
        }
    }

    /// Whether a state lies in it, and how many of its parts it has; none before it or beyond it.
    pub fn parts(&self, has: &Samples, tiles: usize) -> Option<u32> {
        let within = |t: usize| (self.from.of_tile(t)..=self.to.of_tile(t)).contains(&has.of_tile(t));
        if !(0..tiles).all(within) {
            return None;
        }
        (0..=PARTS).rev().find(|&parts| covers(has, &self.after(parts), tiles))
    }

    /// After how many of its parts, one at least, the target is expected to be reached in a film of this size; after all of them where it
    /// is not.
    pub fn first(&self, target: f64, size: [u32; 2]) -> u32 {
        self.expected.iter().position(|e| e.mean(size) <= target).map_or(PARTS, |part| part as u32 + 1)
    }

    /// How many parts have all that was begun of it; all of them if nothing has.
    pub fn holding(&self, begun: &Samples, tiles: usize) -> u32 {
        (0..PARTS).find(|&parts| covers(&self.after(parts), begun, tiles)).unwrap_or(PARTS)
    }

    /// Whether it can be a step of a film of so many tiles.
    pub fn is_sound(&self, tiles: usize) -> bool {
        self.from.is_of(tiles)
            && self.to.is_of(tiles)
            && self.to.most() <= MAX_SPP
            && covers(&self.to, &self.from, tiles)
    }
}

/// Whether no tile has less than in the other.
pub fn covers(samples: &Samples, others: &Samples, tiles: usize) -> bool {
    match (samples, others) {
        (Samples::Even(a), Samples::Even(b)) => a >= b,
        _ => (0..tiles).all(|t| samples.of_tile(t) >= others.of_tile(t)),
    }
}

/// Samples of all pixels.
pub fn total(samples: &Samples, pixels: &[u64]) -> u64 {
    pixels.iter().enumerate().map(|(t, p)| p * u64::from(samples.of_tile(t))).sum()
}

/// Neyman's samples for the mean, within what a tile may have.
fn share(errors: &[ErrorSum], has: &[u32], pixels: &[u64], mean: u32) -> Vec<f64> {
    let tiles = 0..has.len();
    let least: Vec<f64> = has.iter().map(|&n| f64::from(n.max(mean / FLOOR))).collect();
    let most: Vec<f64> = has.iter().map(|&n| f64::from(n.saturating_mul(GROWTH).min(MAX_SPP))).collect();
    let weight = |t: usize| (errors[t].value() * f64::from(has[t]) / pixels[t] as f64).sqrt();
    let weights: Vec<f64> = tiles.clone().map(weight).collect();
    let at = |scale: f64, t: usize| (scale * weights[t]).max(least[t]);
    let cost = |scale: f64| tiles.clone().map(|t| at(scale, t) * pixels[t] as f64).sum::<f64>();
    let budget = f64::from(mean) * pixels.iter().sum::<u64>() as f64;
    // where the tile that needs least for its weight would have it all
    let enough = tiles.clone().filter(|&t| weights[t] > 0.0).map(|t| budget / pixels[t] as f64 / weights[t]);
    let (mut low, mut high) = (0.0, enough.fold(0.0, f64::max));
    // to the last bits of a double
    for _ in 0..f64::MANTISSA_DIGITS {
        let middle = 0.5 * (low + high);
        if cost(middle) < budget { low = middle } else { high = middle }
    }
    // what is too much for one step is not for others, who need it less
    tiles.map(|t| at(high, t).min(most[t])).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn errors(values: &[f64]) -> Vec<ErrorSum> {
        values.iter().map(|&e| ErrorSum::of(e)).collect()
    }

    fn sum(samples: &Samples, has: &Samples, errors: &[f64]) -> f64 {
        let of = |(t, e): (usize, &f64)| e * f64::from(has.of_tile(t)) / f64::from(samples.of_tile(t));
        errors.iter().enumerate().map(of).sum()
    }

    #[test]
    fn noise_gets_samples_and_what_is_calm_keeps_a_floor() {
        let (calm, noisy) = (1e-4, 4.0);
        let step = Step::plan(&errors(&[calm, noisy, calm, calm]), 16.into(), &[1024; 4], 32, true);
        assert_eq!(step.to, Samples::Each(vec![16, 64, 16, 16]), "at most four times as many");
        let step = Step::plan(&errors(&[calm, noisy, calm, calm]), 160.into(), &[1024; 4], 192, true);
        assert_eq!(step.to, Samples::Each(vec![160, 288, 160, 160]));
        // a floor for what was given little
        let from = Samples::Each(vec![16, 1000, 16, 16]);
        let step = Step::plan(&errors(&[calm, noisy, calm, calm]), from.clone(), &[1024; 4], 512, true);
        assert_eq!(step.to, Samples::Each(vec![64, 1856, 64, 64]));
        assert_eq!(step.after(0), from);
        assert_eq!(step.after(1), Samples::Each(vec![28, 1214, 28, 28]));
        assert_eq!(step.after(4), step.to);
    }

    #[test]
    fn without_error_or_not_shared_all_get_the_same() {
        let step = Step::plan(&errors(&[1.0, 2.0, 3.0]), 16.into(), &[1024; 3], 32, false);
        assert_eq!((&step.to, step.after(2)), (&Samples::Even(32), Samples::Even(24)));
        let step = Step::plan(&errors(&[0.0; 3]), 16.into(), &[1024; 3], 32, true);
        assert_eq!(step.to, Samples::Even(24), "there is always something more");
        // what has an error has all that there can be
        let from = Samples::Each(vec![MAX_SPP, 2048, 4096]);
        let step = Step::plan(&errors(&[1.0, 0.0, 0.0]), from, &[1024; 3], 4096, true);
        assert_eq!(step.to, Samples::Each(vec![MAX_SPP, 2056, 4104]));
        assert!(step.is_sound(3) && !step.is_sound(2));
    }

    #[test]
    fn a_step_ends_where_the_target_is_expected() {
        let size = [64, 32];
        let values = [600.0, 60.0];
        let step = Step::plan(&errors(&values), 16.into(), &[1024; 2], 32, true);
        let now = sum(&16.into(), &16.into(), &values) / (3.0 * 64.0 * 32.0);
        let then = |parts: u32| sum(&step.after(parts), &16.into(), &values) / (3.0 * 64.0 * 32.0);
        for parts in 1..=PARTS {
            assert!((step.expected[parts as usize - 1].mean(size) / then(parts) - 1.0).abs() < 1e-12);
            assert_eq!(step.first(then(parts) * 1.001, size), parts);
        }
        assert_eq!((step.first(now, size), step.first(1e-9, size)), (1, PARTS));
        assert_eq!((step.cut(0.0), step.cut(1.0)), (step.from.clone(), step.to.clone()));
        // what was cut lies in its step still
        for (share, parts) in [(0.0, 0), (0.2, 0), (0.3, 1), (0.9, 3), (1.0, 4)] {
            let cut = step.cut(share);
            assert_eq!(step.parts(&cut, 2), Some(parts), "{share}");
            assert_eq!(step.holding(&cut, 2), if share == 0.0 { 0 } else { (parts + 1).min(PARTS) }, "{share}");
        }
        assert_eq!((step.parts(&8.into(), 2), step.parts(&1000.into(), 2)), (None, None));
        assert_eq!(step.holding(&1000.into(), 2), PARTS);
    }

    proptest! {
        /// Against moving samples from tile to tile: nothing that may be moved makes less of the error.
        #[test]
        fn no_other_share_is_better(
            tiles in prop::collection::vec((0.01f64..100.0, 2u32..6, 1u64..1025), 2..9),
            growth in 1.2f64..2.0,
        ) {
            let values: Vec<f64> = tiles.iter().map(|t| t.0).collect();
            let has: Vec<u32> = tiles.iter().map(|t| 8 << t.1).collect();
            let pixels: Vec<u64> = tiles.iter().map(|t| t.2).collect();
            let from = Samples::of(has.clone());
            let before = total(&from, &pixels) as f64 / pixels.iter().sum::<u64>() as f64;
            let mean = (before * growth) as u32;
            let step = Step::plan(&errors(&values), from.clone(), &pixels, mean, true);
            prop_assert!(step.is_sound(tiles.len()));
            let spent = total(&step.to, &pixels) as f64;
            let budget = f64::from(mean) * pixels.iter().sum::<u64>() as f64;
            let rounding = f64::from(GRAIN / 2 + 1) * pixels.iter().sum::<u64>() as f64;
            // some have all that they may have
            let full = (0..tiles.len()).any(|t| step.to.of_tile(t) + GRAIN > has[t] * GROWTH);
            prop_assert!(spent <= budget + rounding && (spent >= budget - rounding || full), "{spent} of {budget}: {step:?}");
            for t in 0..tiles.len() {
                let (n, to) = (has[t], step.to.of_tile(t));
                prop_assert!(to >= n && (to - n) % GRAIN == 0);
                prop_assert!(to <= n * GROWTH + GRAIN && to + GRAIN >= mean / FLOOR, "{n} to {to} of {mean}");
            }
            // the slope of the error over cost, v / n^2 p: whoever could have more has none steeper by more than the rounding than whoever could have less
            let slope = |t: usize, n: f64| values[t] * f64::from(has[t]) / (n * n * pixels[t] as f64);
            for a in 0..tiles.len() {
                for b in 0..tiles.len() {
                    let (na, nb) = (f64::from(step.to.of_tile(a)), f64::from(step.to.of_tile(b)));
                    let grain = f64::from(GRAIN);
                    let may_have_more = na + grain <= f64::from(has[a] * GROWTH);
                    let may_have_less = nb - grain >= f64::from(has[b].max(mean / FLOOR));
                    if may_have_more && may_have_less {
                        prop_assert!(slope(a, na + grain) <= slope(b, (nb - grain).max(1.0)) * 1.000_001, "{a}, {b}: {step:?}");
                    }
                }
            }
            for parts in 0..PARTS {
                prop_assert!(covers(&step.after(parts + 1), &step.after(parts), tiles.len()));
                prop_assert_eq!(step.parts(&step.after(parts), tiles.len()), Some((0..=PARTS).rev().find(|&p| step.after(p) == step.after(parts)).unwrap()));
            }
        }
    }
}
