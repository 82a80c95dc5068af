//! A choice among intervals of whole numbers: exact probabilities, and what is left of the number is as random.

/// All numbers that choose: 31 bits, so that the end of the last interval is one too.
pub(super) const WHOLE: u32 = 1 << 31;

/// What a number chose.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(in crate::light) struct Choice {
    /// Which interval.
    pub(super) at: usize,
    /// Where in it, and how many numbers it has, 1 or more.
    pub(super) rest: u32,
    pub(super) count: u32,
}

impl Choice {
    /// Where in the interval, in (0, 1); `half` is one more bit.
    #[inline(always)]
    pub(super) fn within(&self, half: u32) -> f64 {
        (f64::from(self.rest) + 0.25 + 0.5 * f64::from(half & 1)) / f64::from(self.count)
    }
}

/// Upper ends of consecutive intervals of [0, `whole`) in proportion to the weights; all 0 if the weights are.
pub(super) fn ends(weights: &[f64], whole: u32) -> Vec<u32> {
    let total: f64 = weights.iter().sum();
    if !(total > 0.0) {
        return vec![0; weights.len()];
    }
    let last = weights.iter().rposition(|w| *w > 0.0).unwrap_or(0);
    let mut sum = 0.0;
    let end = |(i, w): (usize, &f64)| {
        sum += w;
        // what is dark lies before or after all numbers, whatever rounding does to the sums
        if i >= last { whole } else { ((sum / total * f64::from(whole)) as u32).min(whole) }
    };
    weights.iter().enumerate().map(end).collect()
}

#[inline]
pub(super) fn before(ends: &[u32], i: usize) -> u32 {
    if i == 0 { 0 } else { ends[i - 1] }
}

/// The interval that holds a number.
#[inline]
pub(super) fn choose(ends: &[u32], among: std::ops::Range<usize>, number: u32) -> Choice {
    // all ends are 0 only where nothing leads
    let at = (among.start + ends[among].partition_point(|&end| end <= number)).min(ends.len() - 1);
    found(ends, at, number)
}

/// [`choose`] among a few, without a branch.
#[inline(always)]
pub(super) fn choose_few<const N: usize>(ends: &[u32; N], number: u32) -> Choice {
    let at = ends.iter().filter(|&&end| end <= number).count().min(N - 1);
    found(ends, at, number)
}

#[inline(always)]
fn found(ends: &[u32], at: usize, number: u32) -> Choice {
    let start = before(ends, at);
    Choice { at, rest: number.wrapping_sub(start), count: ends[at].saturating_sub(start).max(1) }
}

/// For each of equal parts of the numbers the first interval that reaches into it, so that a search touches a line or two of a row of many
/// hundred ends (Chen and Asau, "On Generating Random Variates from an Empirical Distribution", AIIE Transactions 1974).
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Guide {
    /// Parts of a row, as a shift of a number of 31 bits.
    pub(super) shift: u32,
    /// By row: one for each part, and one more.
    firsts: Vec<u32>,
}

impl Guide {
    /// Intervals to a part, about.
    const COARSE: usize = 4;

    /// Over rows of so many ends each.
    pub(super) fn new(ends: &[u32], width: usize) -> Guide {
        let parts = (width / Guide::COARSE).max(1).next_power_of_two();
        let shift = 31 - parts.trailing_zeros();
        let mut firsts = Vec::with_capacity(ends.len() / width * (parts + 1));
        for row in ends.chunks_exact(width) {
            let mut i = 0;
            for part in 0..=parts as u64 {
                let start = part << shift;
                i += row[i..].iter().take_while(|&&end| u64::from(end) <= start).count();
                firsts.push(i as u32);
            }
        }
        Guide { shift, firsts }
    }

    /// Where in a row the interval is that holds a number: the first whose end is above it, or the range's end.
    #[inline]
    pub(super) fn range(&self, row: usize, number: u32) -> std::ops::Range<usize> {
        let at = row * ((WHOLE >> self.shift) as usize + 1) + (number >> self.shift) as usize;
        self.firsts[at] as usize..self.firsts[at + 1] as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Rng;

    /// The guided search finds what a search of the whole row finds, at the ends of intervals and of the guide's parts too.
    #[test]
    fn guided_searches_are_plain_ones() {
        let mut rng = Rng(21);
        for width in [1, 2, 15, 16, 17, 100, 1000, 4099] {
            for dark in [0.0, 0.9, 0.999] {
                let row = |rng: &mut Rng| {
                    let weights: Vec<f64> =
                        (0..width).map(|_| if rng.f32() < dark { 0.0 } else { f64::from(rng.f32()).powi(8) }).collect();
                    ends(&weights, WHOLE)
                };
                let rows = [row(&mut rng), row(&mut rng)];
                let guide = Guide::new(&rows.concat(), width);
                for (k, row) in rows.iter().enumerate() {
                    let part = 1u32 << guide.shift;
                    let edges = row.iter().copied().chain((0..WHOLE / part).map(|i| i * part));
                    let near = edges.flat_map(|n| [n.saturating_sub(1), n, n + 1]).filter(|n| *n < WHOLE);
                    for n in near.chain((0..2000).map(|_| rng.u32() >> 1)).collect::<Vec<_>>() {
                        assert_eq!(choose(row, guide.range(k, n), n), choose(row, 0..width, n), "{n} of {width}");
                    }
                }
            }
        }
    }

    #[test]
    fn few_are_as_many() {
        let mut rng = Rng(22);
        for _ in 0..2000 {
            let whole = (rng.u32() >> (rng.u32() % 32)).clamp(1, WHOLE);
            let weights: [f64; 8] = std::array::from_fn(|_| f64::from(rng.u32() % 4 * (rng.u32() % 3)));
            let ends: [u32; 8] = ends(&weights, whole).try_into().unwrap();
            for _ in 0..20 {
                let n = rng.u32() % whole;
                assert_eq!(choose_few(&ends, n), choose(&ends, 0..8, n));
            }
        }
    }
}
