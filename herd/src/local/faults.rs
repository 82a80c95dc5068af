//! A schedule of faults, a function of its seed: attempts are counted in the order in which they start, so where threads decide that order a seed gives the
//! same mixture of faults, not the same run.

use std::time::Duration;

/// What befalls an attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fate {
    /// Nothing.
    Fine,
    /// It is killed after so many batches.
    Kill(u32),
    /// Its node loses its disk and memory when it reports.
    LoseNode,
    /// It starts late.
    Delay(Duration),
    /// Its result arrives only after its task was committed by another attempt (never by chance: see [`Faults::only`]).
    Straggle,
    /// Its result arrives twice.
    Duplicate,
    /// Its result never arrives.
    LoseResult,
    /// A byte of a copy of an object that it made changes.
    Corrupt,
}

/// A schedule.
#[derive(Clone, Copy, Debug)]
pub struct Faults {
    seed: u64,
    only: Option<(u64, Fate)>,
}

/// Attempts that may be hit, counted over the whole job: so that every schedule comes to an end.
const MOST: u64 = 40;

impl Faults {
    /// The schedule of a seed.
    pub fn new(seed: u64) -> Self {
        Faults { seed, only: None }
    }
    /// One fault: what befalls the `n`-th attempt of the job, and nothing else.
    pub fn only(n: u64, fate: Fate) -> Self {
        Faults { seed: 0, only: Some((n, fate)) }
    }

    /// What befalls the `n`-th attempt of the job. About half of the early ones are hit.
    pub fn fate(&self, n: u64) -> Fate {
        if let Some((which, fate)) = self.only {
            return if n == which { fate } else { Fate::Fine };
        }
        let x = mix(self.seed ^ mix(n));
        // each seed has a mixture of its own
        let rate = mix(self.seed) % 8;
        if n >= MOST || (x >> 8) % 8 >= rate {
            return Fate::Fine;
        }
        match x % 6 {
            0 => Fate::Kill((x >> 16) as u32 % 6),
            1 if (x >> 24).is_multiple_of(3) => Fate::LoseNode,
            2 => Fate::Delay(Duration::from_millis((x >> 32) % 20)),
            3 => Fate::Duplicate,
            4 => Fate::LoseResult,
            5 => Fate::Corrupt,
            _ => Fate::Fine,
        }
    }

    /// A number below `n` (at least 1) for a choice that a fate leaves open.
    pub fn pick(&self, attempt: u64, n: u64) -> u64 {
        mix(self.seed.wrapping_add(1) ^ mix(attempt)) % n.max(1)
    }
}

/// SplitMix64's finaliser.
fn mix(x: u64) -> u64 {
    let mut z = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}
