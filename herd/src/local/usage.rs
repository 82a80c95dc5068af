//! What this process and its threads use, as Linux tells it; zero where it does not.

use std::fs::read_to_string;

/// CPU-seconds of the calling thread.
pub fn thread_cpu() -> f64 {
    let text = read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    text.split_whitespace().next().and_then(|ns| ns.parse::<f64>().ok()).unwrap_or(0.0) * 1e-9
}

/// CPU-seconds of the process, user and system.
pub fn process_cpu() -> f64 {
    let text = read_to_string("/proc/self/stat").unwrap_or_default();
    // the name in parentheses may hold spaces; utime and stime are fields 14 and 15 of all, in ticks of 10 ms
    let fields = text.rsplit(')').next().unwrap_or_default().split_whitespace();
    fields.skip(11).take(2).filter_map(|t| t.parse::<f64>().ok()).sum::<f64>() / 100.0
}

/// The most memory that the process held, bytes.
pub fn peak_memory() -> u64 {
    let text = read_to_string("/proc/self/status").unwrap_or_default();
    let line = text.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    line.and_then(|l| l.split_whitespace().next()).and_then(|kib| kib.parse::<u64>().ok()).unwrap_or(0) * 1024
}
