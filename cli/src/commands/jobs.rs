//! `rayherd jobs`: the jobs of a cluster.

use std::process::ExitCode;

use clap::Args;

use super::print;
use crate::cluster::{Cluster, ClusterOptions, Shown};

/// List the RenderJobs of a cluster
#[derive(Args)]
#[command(after_help = "Examples:\n  rayherd jobs\n  rayherd jobs -n studio\n  rayherd jobs -A")]
pub struct Arguments {
    #[command(flatten)]
    cluster: ClusterOptions,
    /// Of all namespaces
    #[arg(short = 'A', long)]
    all_namespaces: bool,
}

/// Lists them.
pub fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let cluster = Cluster::connect(&arguments.cluster)?;
    let jobs = cluster.jobs(arguments.all_namespaces)?;
    if jobs.is_empty() {
        let place =
            if arguments.all_namespaces { String::new() } else { format!(" in namespace {}", cluster.namespace()) };
        eprintln!("no jobs{place}");
    } else {
        print(&table(&jobs, arguments.all_namespaces))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn table(jobs: &[Shown], with_namespace: bool) -> String {
    let head = ["NAMESPACE", "NAME", "PHASE", "PROGRESS", "ERROR", "REMOTE", "WORKERS", "AGE"].map(str::to_owned);
    let row = |j: &Shown| {
        let j = j.clone();
        [j.namespace, j.name, j.phase, j.progress, j.error, j.remote, j.workers, j.age]
    };
    let rows: Vec<[String; 8]> = std::iter::once(head).chain(jobs.iter().map(row)).collect();
    let first = usize::from(!with_namespace);
    let mut text = String::new();
    for row in &rows {
        let mut line = String::new();
        for column in first..row.len() {
            let width = rows.iter().map(|r| r[column].chars().count()).max().unwrap_or(0);
            line.push_str(&format!("{:width$}   ", row[column]));
        }
        text.push_str(line.trim_end());
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_stand_below_each_other() {
        let job = |name: &str, phase: &str| Shown {
            namespace: "studio".into(),
            name: name.into(),
            phase: phase.into(),
            age: "5s".into(),
            ..Shown::default()
        };
        let text = table(&[job("a", "Complete"), job("longer", "Failed")], false);
        let lines: Vec<&str> = text.lines().collect();
        assert!(!text.contains("studio") && lines[0].starts_with("NAME     PHASE"), "{text}");
        assert_eq!(lines[0].find("AGE"), lines[1].find("5s"));
        assert!(table(&[job("a", "b")], true).starts_with("NAMESPACE"));
    }
}
