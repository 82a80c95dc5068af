//! A worker of a job on a cluster: asks the operator for work, does it next to its node's store, reports.

mod config;
mod link;

use std::process::ExitCode;

use rayherd_herd::remote::Station;
use rayherd_herd::store::Copies;
use tokio::signal::unix::{SignalKind, signal};

use config::Config;
use link::Http;

fn main() -> ExitCode {
    let filter = tracing_subscriber::EnvFilter::try_from_default_env().unwrap_or_else(|_| "info".into());
    tracing_subscriber::fmt().with_env_filter(filter).with_ansi(false).init();
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            tracing::error!("{e:#}");
            ExitCode::FAILURE
        }
    }
}

fn run() -> anyhow::Result<()> {
    let config = Config::from_env()?;
    let depot = config.storage.depot(config.node.as_deref(), &config.credentials)?;
    let home = depot.home().map_or_else(|| "none".into(), |h| h.to_string());
    tracing::info!(number = config.worker.number, slots = config.slots, home, "worker begins");
    let link = Http::new(&config)?;
    let mut station = Station::new(&link, depot, config.slots, config.worker.clone(), config.scratch.clone())?;
    if let Some(folder) = config.cache.as_ref().filter(|_| config.storage.cache > 0) {
        station = station.caching(Copies::in_folder(folder, config.storage.cache));
    }
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    std::thread::scope(|scope| {
        let work = scope.spawn(|| station.run());
        // SIGTERM: what runs is given back, so that others go on with it
        runtime.block_on(async {
            let mut terminate = signal(SignalKind::terminate())?;
            loop {
                tokio::select! {
                    _ = terminate.recv() => {
                        tracing::info!("leaving: what runs is given back");
                        station.leave();
                    }
                    () = tokio::time::sleep(std::time::Duration::from_millis(100)) => {}
                }
                if work.is_finished() {
                    return anyhow::Ok(());
                }
                if station.is_idle() {
                    // slots may still wait for an answer to a question that does not matter any more
                    std::process::exit(i32::from(station.has_panicked()));
                }
            }
        })?;
        work.join().map_err(|_| anyhow::anyhow!("the worker panicked"))??;
        Ok(())
    })
}
