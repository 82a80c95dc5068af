//! Pictures with a target error, whose samples are shared out by what tiles need.

use std::num::NonZeroU32;
use std::sync::{Arc, LazyLock};

use rayherd_render::film::{PerTile, Samples};
use rayherd_render::skip::{Skip, Skips};

use super::tests::{Crash, largest, small, with_store};
use super::*;
use crate::job::{Commits, Silent};
use crate::plan::Strategy;
use crate::store::MemoryStore;
use crate::testing;

/// Three by two tiles, of which two are whole.
const SIZE: [u32; 2] = [80, 48];
const PIXELS: f64 = 80.0 * 48.0;

static SCENE: LazyLock<PreparedScene> = LazyLock::new(|| testing::prepared(&testing::cornell(), 4, true));

fn frame() -> Frame {
    testing::frame(&SCENE, SIZE, 1)
}

fn fixed(spp: u32) -> JobOutcome {
    run(&Sampling { spp, target_error: None, time_limit: None }, &JobSettings::default()).unwrap()
}

fn run(sampling: &Sampling, settings: &JobSettings) -> Result<JobOutcome, JobError> {
    render_local(&SCENE, &frame(), sampling, settings, &Silent)
}

/// Parts of the error that 16 samples leave.
fn target(part: f64) -> Sampling {
    static LEFT: LazyLock<f64> = LazyLock::new(|| fixed(16).report.rel_mse.unwrap());
    Sampling { spp: 4096, target_error: Some(part * *LEFT), time_limit: None }
}

fn straight(sampling: &Sampling) -> JobOutcome {
    run(sampling, &JobSettings::default()).unwrap()
}

fn tiles(made: &JobOutcome) -> &Vec<u32> {
    match &made.samples {
        Samples::Each(tiles) => tiles,
        even => panic!("{even:?}"),
    }
}

fn assert_same(made: &JobOutcome, expected: &JobOutcome, what: &str) {
    assert_eq!(made.samples, expected.samples, "{what}");
    assert!(made.film == expected.film, "{what}");
    assert!(made.image.pixels == expected.image.pixels, "{what}");
}

#[test]
fn samples_go_where_they_are_needed_and_are_those_of_any_other_run() {
    let sampling = target(0.3);
    let made = straight(&sampling);
    let (report, tiles) = (&made.report, tiles(&made));
    println!("{tiles:?}, relMSE {:?} of {:?}", report.rel_mse, sampling.target_error);
    assert!(report.target_reached == Some(true) && report.rel_mse <= sampling.target_error);
    assert_eq!((report.spp, report.most_spp), (made.samples.least(), made.samples.most()));
    assert!(report.spp >= 16 && report.most_spp > report.spp, "{tiles:?}");
    let pixels = [32 * 32, 32 * 32, 16 * 32, 32 * 16, 32 * 16, 16 * 16];
    let all = pixels.iter().zip(tiles).map(|(p, n)| p * u64::from(*n)).sum::<u64>();
    assert_eq!((report.samples, report.rays.camera), (all, all));
    assert_eq!(report.skips["tiles"], u64::from(report.most_spp) * PIXELS as u64 - all);
    // a tile of n samples is what it is in a picture of n samples
    for (tile, &n) in (0..).zip(tiles) {
        let expected = fixed(n);
        let mut seen = 0;
        expected.film.resolve_tile(tile, n, |x, y, value| {
            seen += 1;
            assert_eq!(made.image.pixels[(y * SIZE[0] + x) as usize], value, "{x} {y} of tile {tile}");
        });
        assert_eq!(seen, pixels[tile as usize]);
    }
    // with the same for all, the same error takes more
    let scene = testing::prepared(&testing::cornell(), 4, true).skipping(Skips::ALL.without(Skip::Tiles));
    let even = render_local(&scene, &frame(), &sampling, &JobSettings::default(), &Silent).unwrap();
    assert!(even.report.target_reached == Some(true) && even.samples == Samples::Even(even.report.spp));
    assert_eq!(even.report.skips["tiles"], 0);
    let cost = |r: &Report| r.rel_mse.unwrap() * r.samples as f64;
    assert!(even.report.samples >= report.samples && cost(&even.report) > cost(report), "{:?}", even.samples);
}

#[test]
fn samples_by_tile_do_not_depend_on_who_makes_them() {
    let sampling = target(0.3);
    let expected = straight(&sampling);
    for (i, strategy) in Strategy::ALL.into_iter().enumerate() {
        let settings = JobSettings { memory_per_node: Some(2 * largest(&SCENE)), ..small(strategy, &[2, 1]) };
        assert_same(&run(&sampling, &settings).unwrap(), &expected, strategy.name());
        // faults, among them lost nodes and rays
        let faults = Some(faults::Faults::new(i as u64));
        let settings = JobSettings { faults, threads: NonZeroU32::new(1), replicas: 1, ..settings };
        let made = run(&sampling, &settings).unwrap();
        assert!(made.report.attempts_lost > 0, "{strategy}");
        assert_same(&made, &expected, &format!("{strategy} with faults"));
    }
    // AOVs are divided by as many
    let frame = Frame { aovs: [Aov::Albedo, Aov::Variance].into_iter().collect(), ..frame() };
    let made = render_local(&SCENE, &frame, &sampling, &small(Strategy::Auto, &[1, 1]), &Silent).unwrap();
    assert_eq!(made.samples, expected.samples);
    let channels = made.film.channels(&made.samples, [0.0; 3]);
    let few = Sampling { target_error: None, spp: 32, ..sampling };
    let plain =
        render_local(&SCENE, &frame, &few, &JobSettings::default(), &Silent).unwrap().film.channels(32, [0.0; 3]);
    for (channel, plain) in channels.iter().zip(&plain).filter(|(c, _)| c.name.starts_with("albedo")) {
        let off = channel.values.iter().zip(&plain.values).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(off < 0.5 && channel.values.iter().all(|v| (0.0..=1.0).contains(v)), "{} {off}", channel.name);
    }
    assert!(channels.iter().all(|c| c.values.iter().all(|v| v.is_finite())));
}

#[test]
fn a_run_that_ends_at_any_record_goes_on_to_the_same_samples() {
    let sampling = target(0.5);
    let expected = straight(&sampling);
    for strategy in [Strategy::Auto, Strategy::SchedulingGrid] {
        let store = Arc::new(MemoryStore::default());
        let mut crashes = 0;
        let settings =
            JobSettings { memory_per_node: Some(2 * largest(&SCENE)), task_seconds: 0.02, ..small(strategy, &[1, 1]) };
        for after in (3..).step_by(40) {
            let failing = Arc::new(Crash { after, store: store.clone() });
            let commits = Some(Commits { store: failing, resume: true, takeover: true });
            match run(&sampling, &JobSettings { commits, ..settings.clone() }) {
                Ok(made) => {
                    assert_same(&made, &expected, strategy.name());
                    assert!(made.report.tasks_reused > 0);
                    break;
                }
                Err(JobError::Store(_)) => crashes += 1,
                Err(e) => panic!("{strategy}: {e}"),
            }
        }
        assert!(crashes > 3, "{strategy}: {crashes}");
    }
}

#[test]
fn a_lower_target_or_more_samples_go_on_where_the_last_ones_ended() {
    let store = Arc::new(MemoryStore::default());
    let kept = |resume| with_store(&store, resume, small(Strategy::Auto, &[2]));
    let mut samples = 0;
    for (number, part) in [0.8, 0.62, 0.6, 0.3].into_iter().enumerate() {
        let made = run(&target(part), &kept(number > 0)).unwrap();
        assert_same(&made, &straight(&target(part)), &format!("{part}"));
        println!("{part}: {:?}", made.samples);
        assert!(made.report.samples > samples || part == 0.6, "{part}");
        samples = made.report.samples;
    }
    // an end that is no part's, and on from there
    let more = |n: f64| Sampling { spp: (n * samples as f64 / PIXELS) as u32, ..target(1e-6) };
    for n in [1.3, 1.45] {
        let sampling = more(n);
        let made = run(&sampling, &kept(true)).unwrap();
        assert_eq!(made.report.target_reached, Some(false));
        let mean = made.report.samples as f64 / PIXELS;
        assert!((mean - f64::from(sampling.spp)).abs() < 1.0, "{mean} of {}", sampling.spp);
        assert_same(&made, &straight(&sampling), &format!("{n}"));
    }
    let fewer = run(&more(1.0), &kept(true));
    assert!(fewer.err().unwrap().to_string().contains("samples per pixel"));
    // without a target all get the same in the end
    let most = straight(&more(1.45)).samples.most();
    let fewer = run(&Sampling { spp: most - 1, target_error: None, time_limit: None }, &kept(true));
    assert!(fewer.err().unwrap().to_string().contains(&format!("{most} samples per pixel")));
    let made = run(&Sampling { spp: most + 1, target_error: None, time_limit: None }, &kept(true)).unwrap();
    assert_same(&made, &fixed(most + 1), "without a target");
    // and with one again
    let on = Sampling { spp: 2 * most, ..target(1e-6) };
    let made = run(&on, &kept(true)).unwrap();
    assert!(
        made.samples.least() > most && made.report.samples as f64 / PIXELS >= f64::from(2 * most),
        "{:?}",
        made.samples
    );
}

#[test]
fn time_ends_a_run_with_a_target_as_well() {
    let limited = |seconds| Sampling { time_limit: Some(seconds), ..target(1e-9) };
    let made = run(&limited(0.0), &JobSettings::default()).unwrap();
    assert_eq!(made.samples, Samples::Even(1));
    let made = run(&limited(1.0), &JobSettings::default()).unwrap();
    assert!(made.report.target_reached == Some(false) && made.report.samples as f64 >= PIXELS);
    let (tiles, [width, height]) = (made.film.tiles(), SIZE);
    assert!((0..tiles).all(|t| made.samples.of_tile(t) > 0) && made.report.wall_s < 60.0, "{width}x{height}");
}
