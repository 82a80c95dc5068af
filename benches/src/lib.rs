//! What the benches share.

use anyhow::Context;

/// CPU time of this thread so far, seconds (Linux).
pub fn thread_cpu() -> anyhow::Result<f64> {
    let path = "/proc/thread-self/schedstat";
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {path}"))?;
    let first = text.split(' ').next().context("no figures")?;
    Ok(first.parse::<u64>().with_context(|| format!("{path} has no number"))? as f64 * 1e-9)
}

/// CPU time of all threads of this process so far, those that have ended too, seconds to 0.01 (Linux).
pub fn process_cpu() -> anyhow::Result<f64> {
    let path = "/proc/self/stat";
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {path}"))?;
    // user and system time are fields 14 and 15; the program's name, which may hold spaces, ends with the last parenthesis
    let rest = text.rsplit_once(')').context("no name in it")?.1;
    let ticks = rest.split_whitespace().skip(11).take(2).map(str::parse::<u64>);
    let ticks: u64 = ticks.sum::<Result<u64, _>>().with_context(|| format!("{path} has no number"))?;
    // the kernel tells a hundredth whatever its own clock is
    Ok(ticks as f64 * 0.01)
}

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
