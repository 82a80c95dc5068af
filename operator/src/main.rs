//! The operator: watches RenderJobs, runs their workers, plans and commits their rounds.

mod build;
mod config;
mod finish;
mod jobs;
mod ledger;
mod metrics;
mod reconcile;
mod run;
mod status;
mod storage;
mod tasks;
#[cfg(test)]
mod tests;

use std::process::ExitCode;
use std::sync::Arc;

use futures::StreamExt;
use k8s_openapi::api::core::v1::Pod;
use kube::runtime::controller::Controller;
use kube::runtime::watcher;
use kube::{Api, Client};
use rayherd_api::resource::{RenderJobObject, definition};
use tokio::signal::unix::{SignalKind, signal};

use config::Config;
use reconcile::Context;

/// The API server ends a watch after this many seconds; below what load balancers and proxies cut silently.
const WATCH_SECONDS: u32 = 200;

#[tokio::main]
async fn main() -> ExitCode {
    if std::env::args().nth(1).as_deref() == Some("crd") {
        return match definition().map_err(anyhow::Error::from).and_then(|d| Ok(serde_yaml::to_string(&d)?)) {
            Ok(text) => {
                print!("{text}");
                ExitCode::SUCCESS
            }
            Err(e) => {
                eprintln!("{e:#}");
                ExitCode::FAILURE
            }
        };
    }
    let filter = tracing_subscriber::EnvFilter::try_from_default_env().unwrap_or_else(|_| "info".into());
    tracing_subscriber::fmt().with_env_filter(filter).with_ansi(false).init();
    match run().await {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            tracing::error!("{e:#}");
            ExitCode::FAILURE
        }
    }
}

async fn run() -> anyhow::Result<()> {
    // one provider for every TLS connection of the process
    let _ = rustls::crypto::ring::default_provider().install_default();
    let config = Config::from_env()?;
    let client = Client::try_default().await?;
    let context = Arc::new(Context::new(client.clone(), config)?);
    let tasks = tokio::spawn(tasks::serve(context.clone()));
    let metrics = tokio::spawn(metrics::serve(context.clone()));

    let watch = || watcher::Config::default().timeout(WATCH_SECONDS);
    let jobs: Api<RenderJobObject> = context.everywhere();
    let pods: Api<Pod> = context.everywhere();
    let controller = Controller::new(jobs, watch())
        .owns(pods, watch().labels(build::LABEL))
        .graceful_shutdown_on(terminated())
        .run(reconcile::reconcile, reconcile::failed, context.clone())
        .for_each(|done| async move {
            if let Err(e) = done {
                tracing::warn!("{e}");
            }
        });
    tokio::select! {
        () = controller => {}
        done = tasks => anyhow::bail!("the task server ended: {done:?}"),
        done = metrics => anyhow::bail!("the metrics server ended: {done:?}"),
    }
    // what was committed stays; workers wait for the next operator
    context.jobs.stop_all("the operator ends");
    Ok(())
}

async fn terminated() {
    match signal(SignalKind::terminate()) {
        Ok(mut terminate) => drop(terminate.recv().await),
        Err(e) => {
            tracing::warn!("no signals: {e}");
            std::future::pending::<()>().await;
        }
    }
}
