//! `rayherd logs`: what a job's workers say.

use std::process::ExitCode;

use clap::Args;

use super::{print, print_on};
use crate::cluster::{Cluster, ClusterOptions};

/// Print the logs of a RenderJob's workers, each line after the worker's pod
#[derive(Args)]
#[command(
    after_help = "Examples:\n  rayherd logs chest\n  rayherd logs chest -n studio --tail 20\n  rayherd logs chest -f"
)]
pub struct Arguments {
    /// Name of the job
    job: String,
    #[command(flatten)]
    cluster: ClusterOptions,
    /// Only so many lines of each worker, the last ones
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(i64).range(1..))]
    tail: Option<i64>,
    /// Go on with what they say from now on, until the job is done and its workers are gone
    #[arg(short, long)]
    follow: bool,
}

/// Prints them.
pub fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let cluster = Cluster::connect(&arguments.cluster)?;
    if arguments.follow {
        cluster.follow(&arguments.job, arguments.tail, |pod, line| print_on(&format!("{pod}  {line}\n")))?;
        return Ok(ExitCode::SUCCESS);
    }
    let logs = cluster.logs(&arguments.job, arguments.tail)?;
    if logs.is_empty() {
        eprintln!("job {} has no workers now", arguments.job);
    }
    for (pod, text) in logs {
        let lines: String = text.lines().map(|l| format!("{pod}  {l}\n")).collect();
        print(&lines)?;
    }
    Ok(ExitCode::SUCCESS)
}
