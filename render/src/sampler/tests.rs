use super::*;
use crate::math::unit;
use crate::testing::chi_square;

fn key(pixel: u32, sample: u32, branch: u16) -> PathKey {
    PathKey { pixel, sample, branch, vertex: 0 }
}

#[test]
fn fast_is_the_slow_twin() {
    for (i, &(pixel, sample)) in
        [(0, 0), (1, 1), (77, 30), (65_535, 12_345), (u32::MAX, MAX_SAMPLES - 1)].iter().enumerate()
    {
        for (split, child) in [(1, 0), (16, 0), (16, 15), (MAX_SPLIT, MAX_SPLIT - 1)] {
            let seed = i as u64 * 0x1234_5678_9abc;
            let stream = Stream::new(seed, pixel, sample);
            let k = key(pixel, sample, child as u16);
            for d in 0..2 {
                assert_eq!(stream.film()[d], number(seed, &k, split, 0, d));
            }
            for vertex in [1, 2, 6, 7, 8, 9, 1000] {
                let fast = stream.vertex(vertex, split, child);
                for (d, &x) in fast.iter().enumerate() {
                    assert_eq!(x, number(seed, &k, split, vertex, d), "vertex {vertex} dimension {d} split {split}");
                }
            }
        }
    }
}

/// Of the first 2^k samples of a half one falls in each of 2^k equal intervals, in every dimension, padded or not.
#[test]
fn every_dimension_is_stratified() {
    for half in 0..2 {
        for k in [1, 4, 10] {
            let n = 1u32 << k;
            for vertex in [0, 1, 3, 7, 8, 20] {
                let mut seen = vec![[false; 8]; n as usize];
                for i in 0..n {
                    let stream = Stream::new(9, 1234, 2 * i + half);
                    let film = stream.film();
                    let x =
                        if vertex == 0 { [film[0], film[1], 0, 0, 0, 0, 0, 0] } else { stream.vertex(vertex, 1, 0) };
                    for d in 0..if vertex == 0 { 2 } else { 8 } {
                        let stratum = (x[d] >> (32 - k)) as usize;
                        assert!(!seen[stratum][d], "vertex {vertex} dimension {d} of {n}");
                        seen[stratum][d] = true;
                    }
                }
            }
        }
    }
}

/// The film's two dimensions are a (0, 2)-sequence: each of 2^k boxes of area 2^-k of any shape has one of 2^k points. Padded sets begin with
/// the same two dimensions.
#[test]
fn film_is_a_net() {
    let k = 8;
    for a in 0..=k {
        let mut film = vec![0; 1 << k];
        let mut padded = vec![0; 1 << k];
        for i in 0..1u32 << k {
            let stream = Stream::new(3, 99, 2 * i);
            let index =
                |x: u32, y: u32| (u64::from(x) >> (32 - a) << (k - a) | u64::from(y) >> (32 - (k - a))) as usize;
            let [x, y] = stream.film();
            film[index(x, y)] += 1;
            let v = stream.vertex(9, 1, 0);
            padded[index(v[4], v[5])] += 1;
        }
        assert!(film.iter().all(|&n| n == 1));
        assert!(padded.iter().all(|&n| n == 1));
    }
}

/// The children of all samples are one stratified sequence.
#[test]
fn siblings_share_a_sequence() {
    for split in [4, 16] {
        let n = 64;
        let mut seen = vec![[false; 8]; n * split as usize];
        for i in 0..n as u32 {
            for child in 0..split {
                let x = Stream::new(5, 7, 2 * i + 1).vertex(1, split, child);
                for d in 0..8 {
                    let stratum = ((u64::from(x[d]) * (n as u64 * u64::from(split))) >> 32) as usize;
                    assert!(!seen[stratum][d]);
                    seen[stratum][d] = true;
                }
            }
        }
    }
}

/// Two numbers of a pixel's streams.
type Pair = fn(u32) -> (u32, u32);

/// Pairs of (neighbouring pixel, other half, other seed, other vertex, other dimension) fill the square evenly: no common scramble.
#[test]
fn keys_are_independent() {
    let pairs: [(&str, Pair); 6] = [
        ("neighbours", |p| (Stream::new(1, p, 0).film()[0], Stream::new(1, p + 1, 0).film()[0])),
        ("rows", |p| (Stream::new(1, p, 0).film()[0], Stream::new(1, p + 256, 0).film()[0])),
        ("halves", |p| (Stream::new(1, p, 0).film()[0], Stream::new(1, p, 1).film()[0])),
        ("seeds", |p| (Stream::new(1, p, 0).film()[0], Stream::new(2, p, 0).film()[0])),
        ("vertices", |p| (Stream::new(1, p, 6).vertex(1, 1, 0)[0], Stream::new(1, p, 6).vertex(2, 1, 0)[0])),
        ("dimensions", |p| {
            let v = Stream::new(1, p, 6).vertex(3, 1, 0);
            (v[0], v[1])
        }),
    ];
    for (name, pair) in pairs {
        let n = 50_000;
        let mut counts = vec![0.0; 256];
        for p in 0..n {
            let (x, y) = pair(p);
            counts[((x >> 28) * 16 + (y >> 28)) as usize] += 1.0;
        }
        println!("{name}");
        chi_square(&counts, &vec![f64::from(n) / 256.0; 256]);
    }
}

/// Single bits of neighbouring numbers are uncorrelated, low bits too.
#[test]
fn bits_are_even() {
    let n = 20_000u32;
    let mut ones = [0u32; 32];
    let mut same = [0u32; 32];
    for p in 0..n {
        let x = Stream::new(77, p, 2).vertex(1, 1, 0)[4];
        let y = Stream::new(77, p + 1, 2).vertex(1, 1, 0)[4];
        for b in 0..32 {
            ones[b] += x >> b & 1;
            same[b] += (x ^ y) >> b & 1;
        }
    }
    // five standard deviations
    let slack = 2.5 * f64::from(n).sqrt();
    for b in 0..32 {
        assert!((f64::from(ones[b]) - f64::from(n) / 2.0).abs() < slack, "bit {b}: {}", ones[b]);
        assert!((f64::from(same[b]) - f64::from(n) / 2.0).abs() < slack, "bit {b}: {}", same[b]);
    }
}

/// No number of 32 bits comes twice, at both ends of the range of samples.
#[test]
fn nothing_repeats() {
    let n = 1u32 << 16;
    let range = |start: u32| (start..start + 2 * n).step_by(2);
    let mut all: Vec<u32> = range(0)
        .chain(range(MAX_SAMPLES / 2))
        .chain(range(MAX_SAMPLES - 2 * n))
        .map(|s| Stream::new(1, 2, s).film()[0])
        .collect();
    all.sort_unstable();
    assert!(all.windows(2).all(|w| w[0] != w[1]));
    assert!(all.iter().all(|&x| unit(x) < 1.0));
}
