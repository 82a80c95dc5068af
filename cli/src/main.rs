//! `rayherd`: renders, prepares, compares, replays.

mod bounded;
mod cluster;
mod commands;
mod fault;
mod frames;
mod image_options;
mod interrupt;
mod job_file;
mod kept;
mod log;
mod options;
mod output;
mod progress;
mod run_options;
mod skip_options;
mod source;
mod storage;
mod store;
mod upload;

use std::process::ExitCode;

use clap::Parser;

/// A path tracer for scenes that do not fit one machine: rays go to the data.
#[derive(Parser)]
#[command(
    name = "rayherd",
    version,
    max_term_width = 110,
    after_help = "Start with:  rayherd render examples/cornell-box.xml\n\
                  Logs go to stderr; RUST_LOG=info (or debug) shows more of them."
)]
struct Arguments {
    #[command(subcommand)]
    command: commands::Command,
}

fn main() -> ExitCode {
    fault::install_panic_hook();
    // prints help and mistakes by itself, and exits with 2 for a mistake
    let arguments = Arguments::parse();
    log::install();
    interrupt::install();
    match std::panic::catch_unwind(|| commands::run(arguments.command)) {
        Ok(Ok(code)) => code,
        Ok(Err(error)) if fault::is_interrupted(&error) => {
            eprintln!("{}", fault::tell(&error));
            interrupt::code().map_or(ExitCode::FAILURE, ExitCode::from)
        }
        Ok(Err(error)) => {
            eprintln!("error: {}", fault::tell(&error));
            fault::exit_code(&error).into()
        }
        // the panic hook has told it
        Err(_) => ExitCode::FAILURE,
    }
}
