//! What is shown while a job runs: a bar on a terminal, a line now and then elsewhere, a preview picture.

use std::path::PathBuf;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use rayherd_herd::job::{Image, Progress, Status};
use rayherd_herd::report::RayCounts;

use crate::interrupt;
use crate::log::bars;
use crate::output::{png_file, replace};

/// Seconds between two lines where there is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(5);
/// A preview is not asked for more often.
const PREVIEW_EVERY: Duration = Duration::from_secs(2);
/// Nor takes more than one part in so many of the time.
const PREVIEW_SHARE: u32 = 50;

/// Shows one job.
pub struct Display {
    /// Pixels of the image.
    pixels: u64,
    target_error: Option<f64>,
    preview: Option<(PathBuf, f64)>,
    bar: Option<ProgressBar>,
    state: Mutex<State>,
}

struct State {
    started: Instant,
    last_line: Instant,
    next_preview: Instant,
    preview_failed: bool,
}

impl Display {
    /// A display of a job for an image of so many pixels. The preview goes to a file with an exposure, if wanted.
    pub fn new(pixels: u64, target_error: Option<f64>, preview: Option<(PathBuf, f64)>) -> Self {
        let now = Instant::now();
        let bar = console_is_terminal().then(|| {
            let style = ProgressStyle::with_template("{wide_bar:.cyan/blue} {percent:>3} %  {msg}");
            let bar = ProgressBar::with_draw_target(Some(1), ProgressDrawTarget::hidden());
            if let Ok(style) = style {
                bar.set_style(style);
            }
            bars().add(bar)
        });
        let state = State { started: now, last_line: now, next_preview: now + PREVIEW_EVERY, preview_failed: false };
        Display { pixels, target_error, preview, bar, state: Mutex::new(state) }
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
            bars().remove(bar);
        }
    }

    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}

fn console_is_terminal() -> bool {
    std::io::IsTerminal::is_terminal(&std::io::stderr())
}

impl Progress for Display {
    fn is_cancelled(&self) -> bool {
        interrupt::requested()
    }
    fn status(&self, status: &Status) {
        let text = describe(status, self.pixels, self.target_error);
        if let Some(bar) = &self.bar {
            bar.set_length(status.samples_total.max(1));
            bar.set_position(status.samples);
            bar.set_message(text);
            return;
        }
        let mut state = self.state();
        if state.last_line.elapsed() >= LINE_EVERY {
            state.last_line = Instant::now();
            let percent = 100 * status.samples / status.samples_total.max(1);
            eprintln!("{percent:>3} %  {text}");
        }
    }

    fn wants_error(&self) -> bool {
        true
    }

    fn wants_preview(&self) -> bool {
        self.preview.is_some() && {
            let state = self.state();
            !state.preview_failed && Instant::now() >= state.next_preview
        }
    }

    fn preview(&self, image: &Image) {
        let Some((path, exposure)) = &self.preview else { return };
        let begun = Instant::now();
        let written = png_file::encode(image, *exposure).and_then(|png| replace::replace(path, &png));
        let mut state = self.state();
        if let Err(error) = written {
            tracing::warn!("no more previews: cannot write {}: {error}", path.display());
            state.preview_failed = true;
        }
        state.next_preview = Instant::now() + PREVIEW_EVERY.max(begun.elapsed() * PREVIEW_SHARE);
        tracing::debug!("preview after {:.1} s", state.started.elapsed().as_secs_f64());
    }
}

fn describe(status: &Status, pixels: u64, target_error: Option<f64>) -> String {
    let seconds = status.elapsed.as_secs_f64();
    let rays = |r: &RayCounts| (r.closest + r.shadow) as f64;
    let made = rays(&status.rays) - rays(&status.taken_over);
    let spp = |samples: u64| samples as f64 / pixels.max(1) as f64;
    let mut text = format!(
        "{} rays/s  {:.1} of {:.0} spp",
        si(if seconds > 0.0 { made / seconds } else { 0.0 }),
        spp(status.samples),
        spp(status.samples_total)
    );
    if let Some(error) = status.error {
        text += &format!("  relMSE {error:.2e}");
    }
    if let Some(left) = seconds_left(status, target_error) {
        text += &format!("  {} left", duration(left));
    }
    text
}

/// Samples come at a steady rate, and the error falls as one over their number; whichever ends the run first.
fn seconds_left(status: &Status, target_error: Option<f64>) -> Option<f64> {
    let made = status.samples.saturating_sub(status.taken_over.camera);
    if made == 0 {
        return None;
    }
    let per_sample = status.elapsed.as_secs_f64() / made as f64;
    let left = status.samples_total.saturating_sub(status.samples) as f64;
    let to_target = match (status.error, target_error) {
        (Some(error), Some(target)) => status.samples as f64 * (error / target - 1.0).max(0.0),
        _ => f64::INFINITY,
    };
    Some(per_sample * left.min(to_target))
}

/// In its largest units.
pub fn duration(seconds: f64) -> String {
    match seconds.ceil() as u64 {
        s if s < 60 => format!("{s} s"),
        s if s < 3600 => format!("{} min {:02} s", s / 60, s % 60),
        s => format!("{} h {:02} min", s / 3600, s / 60 % 60),
    }
}

/// Three digits or so with a letter for thousands.
pub fn si(value: f64) -> String {
    let steps = [(1e9, "G"), (1e6, "M"), (1e3, "k")];
    match steps.into_iter().find(|(step, _)| value >= *step) {
        Some((step, letter)) => format!("{:.2} {letter}", value / step),
        None => format!("{value:.0}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_is_one_line() {
        let mut status =
            Status { elapsed: Duration::from_secs(10), samples: 2_000, samples_total: 8_000, ..Status::default() };
        (status.rays.closest, status.rays.shadow) = (20_000_000, 10_000_000);
        assert_eq!(describe(&status, 100, None), "3.00 M rays/s  20.0 of 80 spp  30 s left");
        status.error = Some(0.02);
        assert_eq!(describe(&status, 100, Some(0.01)), "3.00 M rays/s  20.0 of 80 spp  relMSE 2.00e-2  10 s left");
        let none = describe(&Status::default(), 0, None);
        assert_eq!(none, "0 rays/s  0.0 of 0 spp");
        assert_eq!([duration(0.2), duration(61.0), duration(7260.0)], ["1 s", "1 min 01 s", "2 h 01 min"]);
    }
}
