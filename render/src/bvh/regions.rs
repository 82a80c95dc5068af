//! Which parts of a range of numbers are free: bytes of the arena, slots of the forest.

/// Free parts, ascending, never touching each other.
pub(super) struct Regions {
    free: Vec<(u64, u64)>,
}

impl Regions {
    /// All of `start..end` is free.
    pub fn new(start: u64, end: u64) -> Regions {
        Regions { free: if start < end { vec![(start, end)] } else { Vec::new() } }
    }

    /// Takes the lowest free part of `len` > 0 numbers.
    pub fn take(&mut self, len: u64) -> Option<u64> {
        let i = self.free.iter().position(|&(start, end)| end - start >= len)?;
        let (start, end) = self.free[i];
        if end - start == len {
            self.free.remove(i);
        } else {
            self.free[i].0 = start + len;
        }
        Some(start)
    }

    /// Returns what `take` gave.
    pub fn give(&mut self, start: u64, len: u64) {
        let i = self.free.partition_point(|&(s, _)| s < start);
        let end = start + len;
        let joins_left = i > 0 && self.free[i - 1].1 == start;
        let joins_right = i < self.free.len() && self.free[i].0 == end;
        match (joins_left, joins_right) {
            (true, true) => {
                self.free[i - 1].1 = self.free[i].1;
                self.free.remove(i);
            }
            (true, false) => self.free[i - 1].1 = end,
            (false, true) => self.free[i].0 = start,
            (false, false) => self.free.insert(i, (start, end)),
        }
    }

    /// How many numbers are free, and how many of them in the largest part.
    pub fn free(&self) -> (u64, u64) {
        self.free.iter().fold((0, 0), |(sum, most), &(s, e)| (sum + e - s, most.max(e - s)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn takes_first_fit_and_joins_again() {
        let mut r = Regions::new(10, 110);
        let parts: Vec<u64> = (0..10).map(|_| r.take(10).unwrap()).collect();
        assert_eq!(parts, (1..11).map(|i| i * 10).collect::<Vec<_>>());
        assert_eq!(r.take(1), None);
        for i in [3, 7, 5, 6, 0, 9, 1, 2, 8, 4] {
            r.give(parts[i], 10);
            assert!(r.free.windows(2).all(|w| w[0].1 < w[1].0));
        }
        assert_eq!(r.free, [(10, 110)]);
        assert_eq!(r.free(), (100, 100));
    }
}
