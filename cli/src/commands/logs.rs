//! `rayherd logs`: what a job's workers say.

use std::process::ExitCode;

use clap::Args;

use super::print;
use crate::cluster::{Cluster, ClusterOptions};

/// Print the logs of a RenderJob's workers, each line after the worker's pod
#[derive(Args)]
#[command(after_help = "Examples:\n  rayherd logs chest\n  rayherd logs chest -n studio --tail 20")]
pub struct Arguments {
    /// Name of the job
    job: String,
    #[command(flatten)]
    cluster: ClusterOptions,
    /// Only so many lines of each worker, the last ones
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(i64).range(1..))]
    tail: Option<i64>,
}

/// Prints them.
pub fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let cluster = Cluster::connect(&arguments.cluster)?;
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
