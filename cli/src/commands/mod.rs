//! The commands, one a file.

mod check;
mod compare;
mod gc;
mod inspect;
mod jobs;
mod logs;
mod prepare;
mod render;
mod replay;
mod scene;
mod submit;

use std::io::Write;
use std::process::ExitCode;

use anyhow::Context;
use clap::Subcommand;
use rayherd_scene::inspect::size;

/// What to do.
#[derive(Subcommand)]
pub enum Command {
    Render(Box<render::Arguments>),
    Check(check::Arguments),
    Prepare(prepare::Arguments),
    Inspect(inspect::Arguments),
    Compare(compare::Arguments),
    Replay(Box<replay::Arguments>),
    Gc(gc::Arguments),
    Scene(scene::Arguments),
    Submit(Box<submit::Arguments>),
    Jobs(jobs::Arguments),
    Logs(logs::Arguments),
}

/// Does it. The code is the command's answer; an error is told by the caller.
pub fn run(command: Command) -> anyhow::Result<ExitCode> {
    match command {
        Command::Render(arguments) => render::run(&arguments),
        Command::Compare(arguments) => compare::run(&arguments),
        Command::Replay(arguments) => replay::run(&arguments),
        Command::Gc(arguments) => gc::run(&arguments),
        Command::Scene(arguments) => scene::run(&arguments),
        Command::Inspect(arguments) => inspect::run(&arguments),
        Command::Check(arguments) => check::run(&arguments),
        Command::Prepare(arguments) => prepare::run(&arguments),
        Command::Submit(arguments) => submit::run(&arguments),
        Command::Jobs(arguments) => jobs::run(&arguments),
        Command::Logs(arguments) => logs::run(&arguments),
    }
}

/// Prints to stdout. A reader that has gone (`| head`) has seen enough: that is no error.
fn print(text: &str) -> anyhow::Result<()> {
    print_on(text).map(drop)
}

/// Prints to stdout; whether anybody reads on.
fn print_on(text: &str) -> anyhow::Result<bool> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(false),
        written => written.map(|()| true).context("cannot write to standard output"),
    }
}
