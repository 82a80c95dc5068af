//! The film after as many samples as a pixel may have.

use rayherd_render::film::FilmPart;
use rayherd_render::sampler::MAX_SAMPLES;

/// 2^24 samples of values that f32 sums would lose: the mean is exact.
#[test]
fn the_film_does_not_drift() {
    let mut film = FilmPart::new([1, 1]);
    // a third is not a binary fraction; f32 sums of it stall at 2^24 / 3; the others are a billion times smaller and larger
    let values = [1.0f32 / 3.0, 1e-9, 1e9];
    let samples = (0..MAX_SAMPLES).map(|s| (0, s, values));
    film.add_all(samples);
    // what is cut off below 2^-64 of 1e-9 is less than half an ulp of it
    assert_eq!(film.resolve(MAX_SAMPLES)[0], values);
    assert_eq!(film.rel_mse(MAX_SAMPLES), Some(0.0));
    assert_eq!(film.rejected().count, 0);
}

/// A billion to one in one pixel, in any order and in parts: the same sums.
#[test]
fn small_light_is_not_lost_beside_bright() {
    let n = 1 << 16;
    let value = |s: u32| if s.is_multiple_of(2) { [1e9, 1.0, 1e-3] } else { [1.0, 1e-9, 1e-12] };
    let mut forward = FilmPart::new([3, 2]);
    forward.add_all((0..n).map(|s| (4, s, value(s))));
    let mut parts = [FilmPart::new([3, 2]), FilmPart::new([3, 2])];
    for s in (0..n).rev() {
        parts[(s % 3 % 2) as usize].add(4, s, value(s));
    }
    let [mut sum, other] = parts;
    sum.merge(&other).expect("films of one size");
    assert!(sum == forward, "the order changed the sum");
    let expected = [0, 1, 2].map(|c| ((f64::from(value(0)[c]) + f64::from(value(1)[c])) / 2.0) as f32);
    assert_eq!(sum.resolve(n)[4][..2], expected[..2]);
    // 1e-12 is cut off at 2^-64 = 5e-20
    assert!((f64::from(sum.resolve(n)[4][2]) / f64::from(expected[2]) - 1.0).abs() < 1e-7);
}

/// Every number that is no light is counted with its key and adds nothing: NaN, infinities, negative numbers, 2^38 and more.
#[test]
fn what_is_no_light_is_counted() {
    let limit = 274_877_906_944.0f32; // 2^38
    let bad = [f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1e-30, limit, f32::MAX];
    let good = [0.0, -0.0, f32::MIN_POSITIVE / 8.0, limit * (1.0 - f32::EPSILON)];
    let mut film = FilmPart::new([bad.len() as u32, 1]);
    for (pixel, &x) in bad.iter().enumerate() {
        for channel in 0..3 {
            let mut value = [1.0; 3];
            value[channel] = x;
            film.add(pixel as u32, channel as u32, value);
        }
    }
    assert_eq!(film.rejected().count, 3 * bad.len() as u64);
    assert_eq!(film.rejected().keys.iter().next(), Some(&(0, 0)));
    for &x in &good {
        film.add(0, 9, [x; 3]);
    }
    assert_eq!(film.rejected().count, 3 * bad.len() as u64);
    assert_eq!(film.resolve(1)[1..], vec![[0.0; 3]; bad.len() - 1]);
}
