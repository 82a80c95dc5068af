//! The random numbers of a pixel with as many samples as it may have.

use rayherd_render::sampler::{MAX_SAMPLES, PER_VERTEX, Stream};

/// Samples of a half: each half is a sequence of its own.
const HALF: u32 = MAX_SAMPLES / 2;
const BITS: u32 = HALF.trailing_zeros();

/// A set of numbers below 2^[`BITS`].
struct Seen(Vec<u64>);

impl Seen {
    fn new() -> Seen {
        Seen(vec![0; HALF as usize / 64])
    }
    /// Whether it is new.
    fn insert(&mut self, number: u32) -> bool {
        let (word, bit) = (&mut self.0[number as usize / 64], 1 << (number % 64));
        let is_new = *word & bit == 0;
        *word |= bit;
        is_new
    }
}

/// The first 2^23 points of a half have each of 2^23 equal intervals once, in every dimension: nothing repeats, nothing is left out. That is what
/// (0, 1)-sequences in base 2 do (Niederreiter 1992, section 4.1), and Owen's scrambling keeps it.
#[test]
fn no_number_repeats_in_a_pixel() {
    for half in [0, 1] {
        let mut film = [Seen::new(), Seen::new()];
        for i in 0..HALF {
            let numbers = Stream::new(7, 123, 2 * i + half).film();
            for (d, seen) in film.iter_mut().enumerate() {
                assert!(
                    seen.insert(numbers[d] >> (32 - BITS)),
                    "film dimension {d} repeats at sample {}",
                    2 * i + half
                );
            }
        }
    }
    // the first vertex, the last that the sequence serves, one that is padded, one at the bottom of a path of a thousand
    for vertex in [1, 7, 8, 1000] {
        let mut seen: Vec<Seen> = (0..PER_VERTEX).map(|_| Seen::new()).collect();
        for i in 0..HALF {
            let numbers = Stream::new(7, 123, 2 * i).vertex(vertex, 1, 0);
            for (d, seen) in seen.iter_mut().enumerate() {
                assert!(
                    seen.insert(numbers[d] >> (32 - BITS)),
                    "vertex {vertex}, number {d} repeats at sample {}",
                    2 * i
                );
            }
        }
    }
}

/// The film's two dimensions fill the square: of 2^16 points each elementary interval of area 2^-16 has one, whatever its sides.
#[test]
fn places_on_the_film_are_a_net() {
    const M: u32 = 16;
    for half in [0, 1] {
        let points: Vec<[u32; 2]> = (0..1 << M).map(|i| Stream::new(3, 9, 2 * i + half).film()).collect();
        for wide in 0..=M {
            let mut seen = vec![false; 1 << M];
            for [x, y] in &points {
                // `wide` bits of x, the rest of y
                let column = u64::from(*x) >> (32 - wide);
                let row = u64::from(*y) >> (32 - (M - wide));
                let at = (column << (M - wide) | row) as usize;
                assert!(!std::mem::replace(&mut seen[at], true), "two points in one interval of 2^-{wide}");
            }
        }
    }
}
