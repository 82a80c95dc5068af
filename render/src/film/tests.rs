use rayherd_tests::mutation;

use super::*;
use crate::aov::Aov;
use crate::testing::Rng;

const SIZE: [u32; 2] = [70, 45];

fn random_adds(seed: u64, n: usize) -> Vec<(u32, u32, [f32; 3])> {
    let mut rng = Rng(seed);
    (0..n)
        .map(|_| {
            let scale = 2.0f32.powi((rng.u32() % 60) as i32 - 40);
            let pixel = rng.u32() % (SIZE[0] * SIZE[1]);
            (pixel, rng.u32() % 16, std::array::from_fn(|_| rng.f32() * scale))
        })
        .collect()
}

fn filled(adds: &[(u32, u32, [f32; 3])]) -> FilmPart {
    let mut film = FilmPart::new(SIZE);
    for &(pixel, sample, value) in adds {
        film.add(pixel, sample, value);
    }
    film
}

/// Against plain sums in f64, which round but not much.
#[test]
fn sums_are_the_plain_twins() {
    let adds = random_adds(1, 50_000);
    let film = filled(&adds);
    let mut twin = vec![[0.0f64; 3]; (SIZE[0] * SIZE[1]) as usize];
    for &(pixel, _, value) in &adds {
        for c in 0..3 {
            twin[pixel as usize][c] += f64::from(value[c]);
        }
    }
    for (a, b) in film.resolve(7).iter().zip(&twin) {
        for c in 0..3 {
            let b = b[c] / 7.0;
            assert!((f64::from(a[c]) - b).abs() <= b * 6.1e-8 + 1e-15, "{} {b}", a[c]);
        }
    }
}

#[test]
fn order_and_parts_do_not_matter() {
    let mut adds = random_adds(2, 20_000);
    adds.push((5, 3, [f32::NAN, 0.0, 0.0]));
    adds.push((6, 3, [0.0, f32::INFINITY, 0.0]));
    adds.push((7, 3, [0.0, 0.0, -1.0]));
    adds.push((8, 3, [LIMIT, 0.0, 0.0]));
    let whole = filled(&adds);
    assert_eq!(whole.rejected().count, 4);
    assert_eq!(whole.rejected().keys.iter().copied().collect::<Vec<_>>(), [(5, 3), (6, 3), (7, 3), (8, 3)]);
    let mut together = FilmPart::new(SIZE);
    together.add_all(adds.iter().copied());
    assert_eq!(together, whole);
    let mut runs = adds.clone();
    runs.sort_by_key(|a| a.0 / 3 * 3);
    let mut together = FilmPart::new(SIZE);
    together.add_all(runs.into_iter());
    assert_eq!(together, whole);
    let mut rng = Rng(3);
    let mut parts = vec![FilmPart::new(SIZE); 5];
    let mut shuffled = adds.clone();
    for i in (1..shuffled.len()).rev() {
        shuffled.swap(i, rng.u32() as usize % (i + 1));
    }
    for &(pixel, sample, value) in &shuffled {
        parts[rng.u32() as usize % 5].add(pixel, sample, value);
    }
    let mut merged = FilmPart::new(SIZE);
    for part in parts.iter().rev() {
        merged.merge(part).unwrap();
    }
    assert_eq!(merged, whole);
    assert_eq!(merged.encode(), whole.encode());
    assert!(merged.merge(&FilmPart::new([1, 1])).is_err());
}

#[test]
fn kept_keys_are_the_smallest() {
    let mut film = FilmPart::new(SIZE);
    for i in (0..100).rev() {
        film.add(i, 1, [f32::NAN; 3]);
    }
    assert_eq!(film.rejected().count, 100);
    assert!(film.rejected().keys.iter().copied().eq((0..KEPT_KEYS as u32).map(|i| (i, 1))));
    assert_eq!(film.touched(), 0);
}

#[test]
fn floats_become_fixed_exactly() {
    let cases: [(f32, i128); 8] = [
        (0.0, 0),
        (-0.0, 0),
        (1.0, 1 << 64),
        (1.5, 3 << 63),
        (5.421_011e-20, 1), // 2^-64
        (2.710_505_4e-20, 0),
        (f32::MIN_POSITIVE / 2.0, 0),
        (137_438_953_472.0, 1 << 101),
    ];
    for (x, expected) in cases {
        assert_eq!(fixed(x), expected, "{x}");
    }
    let mut rng = Rng(4);
    for _ in 0..100_000 {
        let x = f32::from_bits(rng.u32() & 0x7fff_ffff);
        if x < LIMIT {
            // in f64 the scaling is exact and so is cutting off, below 2^53; above, the float is an integer
            let wide = f64::from(x) * 18_446_744_073_709_551_616.0;
            assert_eq!(fixed(x), wide as i128, "{x}");
        }
    }
}

#[test]
fn bytes_come_back() {
    for n in [0, 1, 100, 20_000] {
        let mut film = filled(&random_adds(5, n));
        film.add(3, 1, [f32::NAN; 3]);
        let bytes = film.encode();
        assert_eq!(FilmPart::decode(&bytes, SIZE).unwrap(), film);
        println!("{n} adds: {} bytes, {} in memory", bytes.len(), film.memory());
        assert!(bytes.len() < 33 + 9 + film.touched() * 132 + n * 3 * 17);
    }
    // also negative sums, which a merge of wrapped sums could hold
    let mut film = FilmPart::new([1, 1]);
    film.tiles[0] = Some(Tile::new());
    let values = [i128::MIN, i128::MAX, -1, 255 << 64, -256, 0x80];
    film.tiles[0].as_mut().unwrap().0[0].as_flattened_mut().copy_from_slice(&values);
    assert_eq!(FilmPart::decode(&film.encode(), [1, 1]).unwrap(), film);
}

/// Whatever was changed, decoding answers; what it accepts is a film of the size.
#[test]
fn bad_bytes_are_refused() {
    let good = filled(&random_adds(6, 300)).encode();
    for n in 0..good.len().min(2000) {
        assert!(FilmPart::decode(&good[..n], SIZE).is_err());
    }
    let mut refused = 0;
    let rounds = mutation::rounds("film", 3000, |random| {
        let mut bad = mutation::bytes(&good, random);
        if random.below(2) == 0 {
            // mostly in the header and the first tile's tables
            let i = random.below(bad.len().min(400));
            if let Some(byte) = bad.get_mut(i) {
                *byte = random.bits() as u8;
            }
        }
        match FilmPart::decode(&bad, SIZE) {
            Ok(film) => assert_eq!(film.size(), SIZE),
            Err(_) => refused += 1,
        }
    });
    assert!(rounds.is_none_or(|n| refused > n / 6 && refused < n), "{refused} of {rounds:?}");
    assert_eq!(FilmPart::decode(b"nothing", SIZE), Err(FilmError::Magic));
    let mut long = good;
    long.push(0);
    assert!(matches!(FilmPart::decode(&long, SIZE), Err(FilmError::Corrupt(_))));
}

/// The quotient is the float nearest to sum / (n 2^64): no other float is nearer, and ties go to even.
#[test]
fn division_rounds_once() {
    let mut rng = Rng(8);
    for i in 0..200_000 {
        let n = if i % 3 == 0 { 1 << (rng.u32() % 25) } else { 1 + rng.u32() % (1 << 24) };
        let mut sum = (u128::from(rng.u64()) << 64 | u128::from(rng.u64())) >> (1 + rng.u32() % 120);
        if i % 5 == 0 {
            // near the middle between two floats
            let float = f32::from_bits((60 + rng.u32() % 60) << 23 | rng.u32() >> 9);
            let next = f32::from_bits(float.to_bits() + 1);
            sum = ((fixed(float) + fixed(next)) / 2 * i128::from(n)) as u128 + u128::from(rng.u32() % 3);
            sum = sum.saturating_sub(1);
        }
        let sum = sum as i128;
        let mut film = FilmPart::new([1, 1]);
        film.tiles[0] = Some(Tile::new());
        film.tiles[0].as_mut().unwrap().0[0][1][2] = sum;
        let q = film.resolve(n)[0][2];
        // distances to q and its neighbours, times n 2^88: all integers when the float is not below 2^-64
        let distance = |x: f32| -> Option<u128> {
            let wide = f64::from(x) * 2.0f64.powi(88);
            if wide.fract() != 0.0 || wide > 1e27 {
                return None;
            }
            let a = (wide as i128).checked_mul(i128::from(n))?;
            Some(a.abs_diff(sum.checked_mul(1 << 24)?))
        };
        if q > 0.0
            && let (Some(d), Some(up), Some(down)) = (distance(q), distance(q.next_up()), distance(q.next_down()))
        {
            assert!(d <= up && d <= down, "{sum} / {n}: {q}");
            if d == up || d == down {
                assert_eq!(q.to_bits() & 1, 0, "{sum} / {n}: a tie to odd");
            }
        }
    }
}

/// The estimate from the halves against the true error, for noise small enough that the mean in the denominator is near the
/// truth; equal and unequal halves.
#[test]
fn error_estimate_is_the_error() {
    let size = [64, 64];
    for samples in [2, 3, 8, 9] {
        let mut film = FilmPart::new(size);
        let mut rng = Rng(9);
        let mut truth = 0.0;
        for pixel in 0..size[0] * size[1] {
            let mean = 0.05 + f64::from(pixel % 64) / 32.0;
            let mut sum = 0.0;
            for s in 0..samples {
                let x = (mean * (0.7 + 0.6 * rng.f64())) as f32;
                film.add(pixel, s, [x; 3]);
                sum += f64::from(x);
            }
            let m = sum / f64::from(samples);
            truth += (m - mean) * (m - mean) / (mean * mean + 0.01);
        }
        truth /= f64::from(size[0] * size[1]);
        let estimate = film.rel_mse(samples).unwrap();
        let map = film.rel_mse_map(samples).unwrap();
        let mean = map.iter().map(|&x| f64::from(x)).sum::<f64>() / map.len() as f64;
        println!("{samples}: {estimate} {truth}");
        assert!((mean / estimate - 1.0).abs() < 1e-4);
        assert!((estimate / truth - 1.0).abs() < 0.15, "{samples}: {estimate} {truth}");
    }
    assert_eq!(FilmPart::new(size).rel_mse(1), None);
    assert_eq!(FilmPart::new(size).rel_mse(2), Some(0.0));
}

/// A film that holds few tiles is the film that holds all, by bands too, and holds no more than it may.
#[test]
fn a_bounded_film_is_the_whole_one_in_less_memory() {
    let mut adds = random_adds(10, 20_000);
    let bad = (0..40).map(|i| (i * 70, i, [f32::NAN; 3]));
    adds.extend(bad);
    let whole = filled(&adds);
    assert_eq!((whole.tiles(), whole.touched()), (6, 6));
    for most in [1, 2, 5, 6, 100] {
        let mut bounded = BoundedFilm::new(SIZE, most);
        for chunk in adds.chunks(97) {
            bounded.add_all(chunk.iter().copied());
            assert!(bounded.part.touched() <= most);
        }
        assert_eq!((bounded.touched(), bounded.packings() == 0), (6, most >= 6));
        assert_eq!(bounded.clone().into_part(), whole);
        for size in [1, 2, 4, 6, 1000] {
            let (mut sum, mut error, mut bands) = (FilmPart::new(SIZE), ErrorSum::default(), Vec::new());
            let mut resolved = vec![[0.0; 3]; (SIZE[0] * SIZE[1]) as usize];
            let each = |band: u32, bytes: Vec<u8>| {
                bands.push(band);
                let part = FilmPart::decode(&bytes, SIZE)?;
                let range = band * size..(band + 1) * size;
                assert!(part.tiles.iter().enumerate().all(|(n, t)| t.is_none() || range.contains(&(n as u32))));
                error += part.error_sum(16).unwrap();
                for tile in 0..6 {
                    part.resolve_tile(tile, 16, |x, y, value| resolved[(y * SIZE[0] + x) as usize] = value);
                }
                sum.add_encoded(&bytes, 0..6)
            };
            bounded.clone().into_bands(size, each).unwrap();
            assert_eq!(sum, whole);
            assert_eq!(bands, (0..6u32.div_ceil(size)).collect::<Vec<_>>());
            assert_eq!((Some(error.mean(SIZE)), resolved), (whole.rel_mse(16), whole.resolve(16)));
            let text = serde_json::to_string(&error).unwrap();
            assert_eq!(serde_json::from_str::<ErrorSum>(&text).unwrap(), error);
        }
    }
    let mut all = BoundedFilm::new(SIZE, 2);
    all.add(3, 1, [1.0; 3]);
    all.touch_all();
    assert_eq!((all.touched(), all.part.touched()), (6, 2));
    assert_eq!(all.into_part().touched(), 6);
    // what takes a tenth of the tiles packs ten times; sparse tiles take few bytes
    let wide = [32 * 400, 32];
    let mut sparse = BoundedFilm::new(wide, 40);
    (0..400).for_each(|tile| sparse.add(32 * tile + 5, 0, [0.5; 3]));
    assert_eq!((sparse.touched(), sparse.packings()), (400, 9));
    let full = 400 * (TILE * TILE) as usize * size_of::<Sums>();
    assert!(sparse.memory() < full / 8, "{} of {full}", sparse.memory());
}

/// Some tiles of a part can be had without the others, and what is no part of the film changes nothing.
#[test]
fn tiles_are_read_alone() {
    let mut adds = random_adds(11, 5000);
    adds.extend((0..60).map(|i| (i * 50, 1, [-1.0; 3])));
    let whole = filled(&adds);
    let bytes = whole.encode();
    assert_eq!(FilmPart::check(&bytes, SIZE), Ok(()));
    let mut sum = FilmPart::new(SIZE);
    for range in [4..6, 0..1, 1..4] {
        sum.add_encoded(&bytes, range.clone()).unwrap();
        assert!(range.into_iter().all(|t: u32| sum.tiles[t as usize] == whole.tiles[t as usize]));
    }
    assert_eq!(sum, whole);
    let before = sum.clone();
    for n in (0..bytes.len()).step_by(501) {
        assert!(sum.add_encoded(&bytes[..n], 0..6).is_err());
    }
    assert!(sum.add_encoded(&FilmPart::new([1, 1]).encode(), 0..6).is_err());
    assert_eq!(sum, before);
}

const BESIDE: [Aov; 4] = [Aov::Normal, Aov::Position, Aov::ObjectId, Aov::Cost];

fn beside() -> Layout {
    Layout { size: SIZE, aovs: BESIDE.into_iter().collect() }
}

/// Values of either sign for AOVs.
fn random_aovs(seed: u64, n: usize) -> Vec<(Aov, u32, u32, Vec<f32>)> {
    let mut rng = Rng(seed);
    let mut one = || {
        let aov = BESIDE[(rng.u32() % 4) as usize];
        let scale = 2.0f32.powi((rng.u32() % 60) as i32 - 40);
        let pixel = rng.u32() % (SIZE[0] * SIZE[1]);
        let values = (0..aov.sums()).map(|_| rng.range(-1.0, 1.0) * scale).collect();
        (aov, pixel, rng.u32() % 16, values)
    };
    (0..n).map(|_| one()).collect()
}

fn filled_beside(adds: &[(Aov, u32, u32, Vec<f32>)]) -> FilmPart {
    let mut film = FilmPart::new(beside());
    adds.iter().for_each(|(aov, pixel, sample, values)| film.add_aov(*aov, *pixel, *sample, values));
    film
}

#[test]
fn sums_of_aovs_are_the_plain_twins_in_any_order_and_parts() {
    let adds = random_aovs(11, 30_000);
    let whole = filled_beside(&adds);
    let mut twin = std::collections::BTreeMap::<(Aov, u32, usize), f64>::new();
    for (aov, pixel, _, values) in &adds {
        for (c, &x) in values.iter().enumerate() {
            *twin.entry((*aov, *pixel, c)).or_default() += f64::from(x);
        }
    }
    let channels = whole.channels(7, [0.0; 3]);
    for aov in BESIDE {
        for (c, name) in aov.channels().iter().enumerate() {
            let channel = channels.iter().find(|c| c.name == *name).unwrap();
            for (pixel, &found) in channel.values.iter().enumerate() {
                let sum = twin.get(&(aov, pixel as u32, c)).copied().unwrap_or(0.0);
                let expected = if aov == Aov::ObjectId { sum } else { sum / 7.0 };
                // of numbers up to 2^19 that cancel each other, in f64
                assert!(
                    (f64::from(found) - expected).abs() <= expected.abs() * 1e-7 + 1e-8,
                    "{name}: {found} {expected}"
                );
            }
        }
    }
    let mut shuffled = adds.clone();
    let mut rng = Rng(12);
    for i in (1..shuffled.len()).rev() {
        shuffled.swap(i, rng.u32() as usize % (i + 1));
    }
    let mut merged = FilmPart::new(beside());
    for part in shuffled.chunks(7000).rev() {
        let part = filled_beside(part);
        assert!(!part.is_empty() && part.touched() == 0);
        merged.merge(&FilmPart::decode(&part.encode(), beside()).unwrap()).unwrap();
    }
    assert_eq!(merged, whole);
    assert_eq!(merged.encode(), whole.encode());
    // beside light as without
    let light = random_adds(13, 5000);
    light.iter().for_each(|&(pixel, sample, value)| merged.add(pixel, sample, value));
    assert_eq!(merged.resolve(3), filled(&light).resolve(3));
    assert_eq!(merged.channels(7, [0.0; 3]), channels);
    assert_eq!(FilmPart::decode(&merged.encode(), beside()).unwrap(), merged);
    merged.keep_aovs(Aovs::NONE);
    assert_eq!(merged, filled(&light));
    assert_eq!(merged.encode(), filled(&light).encode());
}

/// A film with AOVs that holds few tiles is the film that holds all, by bands too, and holds no more memory than it may.
#[test]
fn a_bounded_film_with_aovs_is_the_whole_one_in_less_memory() {
    let (light, mut aovs) = (random_adds(20, 10_000), random_aovs(21, 10_000));
    aovs.extend((0..40).map(|i| (Aov::Cost, i * 70, i, vec![f32::NAN])));
    let mut whole = filled_beside(&aovs);
    light.iter().for_each(|&(pixel, sample, value)| whole.add(pixel, sample, value));
    let tile = beside().pixel_bytes() * (TILE * TILE) as usize;
    let places = whole.memory() - 6 * tile;
    // of light alone; of 15 sums a pixel there are 6 of light
    for most in [1, 5, 8, 14, 15, 100] {
        let mut bounded = BoundedFilm::new(beside(), most);
        for (light, aovs) in light.chunks(97).zip(aovs.chunks(97)) {
            bounded.add_all(light.iter().copied());
            let held = |film: &BoundedFilm| film.part.memory() - places;
            assert!(held(&bounded) <= (most * 6 / 15).max(1) * tile);
            for (aov, pixel, sample, values) in aovs {
                bounded.add_aov(*aov, *pixel, *sample, values);
            }
            assert!(held(&bounded) <= (most * 6 / 15).max(1) * tile);
        }
        assert_eq!((bounded.touched(), bounded.packings() == 0), (6, most >= 15));
        assert!(bounded.clone().into_part() == whole);
        for kept in [Aovs::NONE, [Aov::Position].into_iter().collect(), beside().aovs] {
            let (mut whole, mut bounded) = (whole.clone(), bounded.clone());
            whole.keep_aovs(kept);
            bounded.keep_aovs(kept);
            assert!(bounded.clone().into_part() == whole);
            // what comes later is packed beside what was packed with all
            for &(pixel, sample, value) in &light[..500] {
                bounded.add(pixel, sample, value);
                whole.add(pixel, sample, value);
            }
            for size in [1, 4, 1000] {
                let (mut sum, mut bands) = (FilmPart::new(whole.layout()), Vec::new());
                let mut channels: Vec<Vec<f32>> = kept.channels().map(|_| vec![f32::NAN; 70 * 45]).collect();
                let each = |band: u32, bytes: Vec<u8>| {
                    bands.push(band);
                    let part = FilmPart::decode(&bytes, whole.layout())?;
                    assert!((0..6).all(|tile| !part.holds(tile) || tile as u32 / size == band));
                    for tile in (band * size..6).take(size as usize) {
                        part.channels_of_tile(tile, 16, [1.0; 3], |x, y, channel, value| {
                            channels[channel][(y * SIZE[0] + x) as usize] = value;
                        });
                    }
                    sum.add_encoded(&bytes, 0..6)
                };
                bounded.clone().into_bands(size, each).unwrap();
                assert!(sum == whole);
                assert_eq!(bands, (0..6u32.div_ceil(size)).collect::<Vec<_>>());
                let expected = whole.channels(16, [1.0; 3]);
                assert!(channels.iter().zip(&expected).all(|(found, expected)| *found == expected.values));
            }
        }
    }
    // tiles without light, and light without these
    let mut few = BoundedFilm::new(beside(), 1);
    few.add_aov(Aov::Cost, 3, 0, &[1.0]);
    few.add(40, 0, [1.0; 3]);
    few.add_aov(Aov::Cost, SIZE[0] * 40, 0, &[2.0]);
    few.add_aov(Aov::Cost, 5, 0, &[4.0]);
    assert_eq!((few.touched(), few.packings()), (1, 3));
    few.touch_all();
    let part = few.into_part();
    assert!(part.tiles.iter().all(Option::is_some) && part.planes.tiles.iter().all(Option::is_some));
    let cost = &part.channels(1, [0.0; 3])[7];
    assert_eq!((cost.name, cost.values[3], cost.values[5], cost.values[70 * 40]), ("cost.Y", 1.0, 4.0, 2.0));
    assert_eq!(cost.values.iter().sum::<f32>(), 7.0);
}

/// Some tiles of a part with AOVs can be had without the others.
#[test]
fn tiles_with_aovs_are_read_alone() {
    let mut whole = filled_beside(&random_aovs(22, 3000));
    random_adds(23, 50).iter().for_each(|&(pixel, sample, value)| whole.add(pixel, sample, value));
    let bytes = whole.encode();
    assert_eq!(FilmPart::check(&bytes, beside()), Ok(()));
    assert!(matches!(FilmPart::check(&bytes, SIZE), Err(FilmError::Aovs { .. })));
    let mut sum = FilmPart::new(beside());
    for range in [4..6, 0..1, 1..4] {
        sum.add_encoded(&bytes, range.clone()).unwrap();
        for tile in range.start as usize..range.end as usize {
            assert!(sum.tiles[tile] == whole.tiles[tile] && sum.planes.get(tile) == whole.planes.get(tile));
        }
    }
    assert!(sum == whole);
    for n in (0..bytes.len()).step_by(501) {
        assert!(sum.add_encoded(&bytes[..n], 0..6).is_err());
    }
    assert!(sum.add_encoded(&filled(&random_adds(24, 10)).encode(), 0..6).is_err());
    assert!(sum == whole);
}

#[test]
fn films_of_other_aovs_do_not_add_up() {
    let (mut film, plain) = (filled_beside(&random_aovs(14, 100)), filled(&random_adds(15, 100)));
    assert!(matches!(film.merge(&plain), Err(FilmError::Aovs { .. })));
    assert!(matches!(FilmPart::decode(&plain.encode(), beside()), Err(FilmError::Aovs { .. })));
    let error = FilmPart::decode(&film.encode(), SIZE).unwrap_err().to_string();
    assert!(error.contains("normal, position, objectId, cost; expected: none"), "{error}");
    film.add_aov(Aov::Normal, 3, 4, &[0.0, f32::NAN, 0.0]);
    film.add_aov(Aov::Cost, 2, 4, &[-LIMIT]);
    assert_eq!(film.rejected().keys.iter().copied().collect::<Vec<_>>(), [(2, 4), (3, 4)]);
    // the variance has no sums: such a film is as large as one without
    let variance = Layout { size: SIZE, aovs: Aovs::from_iter([Aov::Variance]) };
    let mut film = FilmPart::new(variance);
    assert!(film.is_empty() && film.memory() == FilmPart::new(SIZE).memory());
    film.touch_all();
    assert_eq!(FilmPart::decode(&film.encode(), variance).unwrap(), film);
}

#[test]
fn bad_bytes_with_aovs_are_refused() {
    let mut film = filled_beside(&random_aovs(16, 300));
    random_adds(17, 30).iter().for_each(|&(pixel, sample, value)| film.add(pixel, sample, value));
    let good = film.encode();
    for n in (0..good.len()).step_by(7) {
        assert!(FilmPart::decode(&good[..n], beside()).is_err());
    }
    let mut refused = 0;
    let rounds = mutation::rounds("film with AOVs", 2000, |random| {
        match FilmPart::decode(&mutation::bytes(&good, random), beside()) {
            Ok(film) => assert_eq!(film.layout(), beside()),
            Err(_) => refused += 1,
        }
    });
    assert!(rounds.is_none_or(|n| refused > n / 6 && refused < n), "{refused} of {rounds:?}");
}

/// The variance against that of pictures of other numbers.
#[test]
fn variance_is_that_of_the_picture() {
    let (size, n) = ([64, 64], 8);
    let layout = Layout { size, aovs: Aovs::from_iter([Aov::Variance]) };
    let mut rng = Rng(18);
    let (mut estimate, mut truth) = (0.0, 0.0);
    let mut film = FilmPart::new(layout);
    for pixel in 0..size[0] * size[1] {
        let mut sum = 0.0;
        for sample in 0..n {
            let x = 0.5 + 0.5 * rng.f32();
            film.add(pixel, sample, [x, 0.0, x]);
            sum += f64::from(x);
        }
        truth += (sum / f64::from(n) - 0.75).powi(2);
    }
    let channels = film.channels(n, [0.0; 3]);
    assert_eq!(channels.iter().map(|c| c.name).collect::<Vec<_>>(), ["variance.R", "variance.G", "variance.B"]);
    estimate += channels[0].values.iter().map(|&x| f64::from(x)).sum::<f64>();
    assert!((estimate / truth - 1.0).abs() < 0.1, "{estimate} {truth}");
    assert!(channels[1].values.iter().all(|&x| x == 0.0));
    // one sample tells nothing of it
    assert!(film.channels(1, [0.0; 3])[0].values.iter().all(|&x| x == f32::INFINITY));
}
