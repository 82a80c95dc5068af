//! What the benches share.

pub use rayherd_herd::local::usage::{process_cpu, thread_cpu};

/// The middle of some figures.
pub fn median(mut figures: Vec<f64>) -> f64 {
    figures.sort_by(f64::total_cmp);
    let n = figures.len();
    0.5 * (figures[(n - 1) / 2] + figures[n / 2])
}

/// Order statistics that hold the median of what was measured with at least 95 % (binomial), as far as there are enough figures.
pub fn interval(figures: &[f64]) -> (f64, f64) {
    let mut sorted = figures.to_vec();
    sorted.sort_by(f64::total_cmp);
    let n = sorted.len();
    let (mut tail, mut k, mut p) = (0.0, 0, 0.5f64.powi(n as i32));
    while k < n / 2 && tail + p <= 0.025 {
        tail += p;
        k += 1;
        p = p * (n - k + 1) as f64 / k as f64;
    }
    (sorted[k.saturating_sub(1)], sorted[(n - k).min(n - 1)])
}
