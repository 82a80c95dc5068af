//! Logs to stderr, filtered by `RUST_LOG`; warnings and errors without it.

use std::io::{self, Write};
use std::sync::OnceLock;

use indicatif::MultiProgress;
use tracing_subscriber::EnvFilter;

/// Starts logging for the whole process.
pub fn install() {
    let filter = EnvFilter::builder().with_default_directive(tracing::Level::WARN.into()).from_env_lossy();
    let lines = tracing_subscriber::fmt().with_env_filter(filter).with_target(false).with_writer(|| AboveBars);
    lines.with_ansi(io::IsTerminal::is_terminal(&io::stderr())).init();
}

/// The bars on the terminal, which lines of the log must not run into.
pub fn bars() -> &'static MultiProgress {
    static BARS: OnceLock<MultiProgress> = OnceLock::new();
    BARS.get_or_init(MultiProgress::new)
}

struct AboveBars;

impl Write for AboveBars {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        bars().suspend(|| io::stderr().write(line))
    }
    fn flush(&mut self) -> io::Result<()> {
        io::stderr().flush()
    }
}
