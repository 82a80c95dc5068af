//! What stopping at a target error leaves in a picture: whoever stops when an estimate is low enough stops a little more often where it is low
//! by chance. Measured with many seeds against the same seeds without a target; docs/numerics.md has the figures.
//!
//! `RAYHERD_STOP_SEEDS=1000` for those of the document.

mod example;

use rayherd_herd::job::{JobSettings, PreparedScene, Sampling, Silent};
use rayherd_herd::local::{JobOutcome, render_local};
use rayherd_render::frame::Frame;
use rayherd_scene::prepare::PrepareSettings;

/// The mean may be off by this share of itself, beside the noise of the measurement.
const BIAS: f64 = 1e-2;
/// The error that is left may be so many times the target: few samples tell little of rare bright ones.
const LEFT: f64 = 5.0;

fn seeds() -> u64 {
    match std::env::var("RAYHERD_STOP_SEEDS") {
        Ok(text) => text.parse().unwrap_or_else(|_| panic!("RAYHERD_STOP_SEEDS is {text:?}: give a number of seeds")),
        Err(_) => 50,
    }
}

fn render(scene: &PreparedScene, frame: &Frame, seed: u64, spp: u32, target: Option<f64>) -> JobOutcome {
    let frame = Frame { seed, ..frame.clone() };
    let sampling = Sampling { spp, target_error: target, time_limit: None };
    render_local(scene, &frame, &sampling, &JobSettings::default(), &Silent).unwrap()
}

/// Mean and its standard error.
fn mean(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0);
    (mean, (variance / n).sqrt())
}

fn pixels(made: &JobOutcome) -> Vec<f64> {
    made.image.pixels.as_flattened().iter().map(|&x| f64::from(x)).collect()
}

/// Mean squared error relative to the truth, as [`rayherd_render::film::FilmPart::rel_mse`] has it.
fn rel_mse(picture: &[f64], truth: &[f64]) -> f64 {
    let each = picture.iter().zip(truth).map(|(p, t)| (p - t).powi(2) / (t * t + 0.01));
    each.sum::<f64>() / truth.len() as f64
}

#[test]
fn what_stopping_at_a_target_leaves() {
    measure(12, 64, &[0.06, 0.015]);
}

/// The same where samples are shared out among tiles by what they were found to need: four of them, of 1,024 to 4 pixels.
#[test]
fn what_sharing_samples_out_leaves() {
    measure(34, 192, &[0.004]);
}

/// Of a picture of `size` by `size` pixels against `most` samples a pixel, which are more than any target takes.
fn measure(size: u32, most: u32, targets: &[f64]) {
    let (scene, frame) = example::prepared("cornell-box.xml", size, 6, &PrepareSettings::default());
    let seeds = seeds();
    let fixed: Vec<Vec<f64>> = (0..seeds).map(|seed| pixels(&render(&scene, &frame, seed, most, None))).collect();
    let mut truth = vec![0.0; fixed[0].len()];
    fixed.iter().for_each(|picture| truth.iter_mut().zip(picture).for_each(|(t, p)| *t += p / seeds as f64));
    let level = truth.iter().sum::<f64>() / truth.len() as f64;
    for &target in targets {
        let (mut off, mut squares, mut samples, mut told, mut real) = (vec![], vec![], vec![], vec![], vec![]);
        for (seed, fixed) in (0..seeds).zip(&fixed) {
            let made = render(&scene, &frame, seed, most, Some(target));
            assert_eq!(made.report.target_reached, Some(true), "seed {seed}");
            let picture = pixels(&made);
            // the same samples begin both, so most of the noise is the same
            let differences: Vec<f64> = picture.iter().zip(fixed).map(|(p, f)| (p - f) / level).collect();
            off.push(differences.iter().sum::<f64>() / differences.len() as f64);
            squares.push(differences);
            samples.push(made.report.samples as f64 / f64::from(size * size));
            told.push(made.report.rel_mse.unwrap());
            real.push(rel_mse(&picture, &truth));
        }
        let ((off, error), (spp, _)) = (mean(&off), mean(&samples));
        let ((told, _), (real, real_error)) = (mean(&told), mean(&real));
        // of single values of pixels: the largest, in standard errors, of as many as there are
        let of_pixel = |i: usize| mean(&squares.iter().map(|d| d[i]).collect::<Vec<f64>>());
        let worst = (0..truth.len()).map(of_pixel).map(|(m, e)| m.abs() / e).fold(0.0, f64::max);
        println!(
            "target {target}, {seeds} seeds: {spp:.2} samples ({:.0} to {:.0}); the mean is off by {off:+.2e} +- {error:.2e} of itself, \
             the worst of {} values by {worst:.1} standard errors; relMSE told {told:.4}, real {real:.4} +- {real_error:.4}",
            samples.iter().copied().fold(f64::MAX, f64::min),
            samples.iter().copied().fold(0.0, f64::max),
            truth.len()
        );
        assert!(samples.iter().any(|&n| n != samples[0]), "all seeds stop at {spp} samples: nothing is chosen");
        assert!(samples.iter().all(|&n| (2.0..f64::from(most)).contains(&n)), "{samples:?}");
        assert!(off.abs() < BIAS + 4.0 * error, "target {target}: off by {off} +- {error}");
        // what is told at the end was chosen for being low
        assert!(real < LEFT * target + 4.0 * real_error, "target {target}: relMSE is {real} +- {real_error}");
    }
}
