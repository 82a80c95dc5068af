//! What the benches share.

use anyhow::Context;

/// CPU time of this thread so far, seconds (Linux).
pub fn thread_cpu() -> anyhow::Result<f64> {
    let path = "/proc/thread-self/schedstat";
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {path}"))?;
    let first = text.split(' ').next().context("no figures")?;
    Ok(first.parse::<u64>().with_context(|| format!("{path} has no number"))? as f64 * 1e-9)
}

/// The middle of some figures.
pub fn median(mut figures: Vec<f64>) -> f64 {
    figures.sort_by(f64::total_cmp);
    figures[figures.len() / 2]
}
