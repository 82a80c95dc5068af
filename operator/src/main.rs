//! The operator: watches RenderJobs, runs their workers, plans and commits their rounds.

mod authority;
mod backoff;
mod buckets;
mod build;
mod config;
mod finish;
mod jobs;
mod kills;
mod lease;
mod ledger;
mod metrics;
mod reconcile;
mod retention;
mod run;
mod status;
mod storage;
mod tasks;
#[cfg(test)]
mod tests;
mod tls;
mod trial;
mod trigger;
mod watching;

use std::process::ExitCode;
use std::sync::Arc;
use std::time::Instant;

use futures::StreamExt;
use futures::channel::mpsc;
use k8s_openapi::api::core::v1::Pod;
use kube::api::{Patch, PatchParams};
use kube::runtime::controller::{self, Controller};
use kube::runtime::{WatchStreamExt, reflector, watcher};
use kube::{Api, client::ClientBuilder};
use rayherd_api::resource::definition;
use serde_json::json;
use tokio::signal::unix::{SignalKind, signal};

use config::Config;
use lease::Lease;
use metrics::Metrics;
use reconcile::Context;

/// The API server ends a watch after this many seconds; below what load balancers and proxies cut silently.
const WATCH_SECONDS: u32 = 200;

/// Jobs that are looked at at a time; each look takes some requests, one after the other.
const CONCURRENCY: u16 = 16;

/// Marks the operator's pod that leads.
const LEADER: &str = "rayherd.io/leader";

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
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let done = match arguments.first().map(String::as_str) {
        Some("trial") => try_render().await,
        Some("buckets") => buckets::make(&arguments[1..]).await,
        _ => run().await,
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            tracing::error!("{e:#}");
            ExitCode::FAILURE
        }
    }
}

async fn try_render() -> anyhow::Result<()> {
    let _ = rustls::crypto::ring::default_provider().install_default();
    trial::try_render().await
}

async fn run() -> anyhow::Result<()> {
    // one provider for every TLS connection of the process
    let _ = rustls::crypto::ring::default_provider().install_default();
    let config = Config::from_env()?;
    let metrics = Metrics::new()?;
    let settings = kube::Config::infer().await?;
    let client = ClientBuilder::try_from(settings)?.with_layer(&metrics.requests()).build();
    let (steps, stirred) = mpsc::unbounded();
    let context = Arc::new(Context::new(client.clone(), config, metrics, steps));
    let mut metrics = tokio::spawn(metrics::serve(context.clone()));
    let Config { namespace, pod, lease, .. } = &context.config;
    leads(&context, false).await?;
    let lease = Arc::new(Lease::new(client.clone(), namespace, lease, pod));
    tokio::select! {
        () = lease.acquire() => {}
        () = terminated() => return Ok(()),
        done = &mut metrics => anyhow::bail!("the metrics server ended: {done:?}"),
    }
    lease.watch()?;
    let of_task = lease.clone();
    tokio::spawn(async move { of_task.keep().await });
    let tls = tasks::open(&context).await?;
    let tasks = tokio::spawn(tasks::serve(context.clone(), tls));
    leads(&context, true).await?;
    let left = context.left.clone();
    tokio::spawn(async move { left.keep().await });
    tokio::spawn(retention::keep(context.clone()));
    context.metrics.leader.set(1);

    let watch = || watcher::Config::default().timeout(WATCH_SECONDS);
    let jobs: Api<reconcile::Seen> = context.everywhere();
    let pods: Api<Pod> = context.everywhere();
    let (known, writer) = reflector::store();
    let seen = watcher(jobs, watch()).reflect(writer).applied_objects();
    let controller = Controller::for_stream(seen.predicate_filter(trigger::stirs, Default::default()), known)
        .reconcile_on(stirred)
        .owns(pods, watch().labels(build::LABEL))
        .with_config(controller::Config::default().concurrency(CONCURRENCY))
        .graceful_shutdown_on(terminated())
        .run(reconcile::reconcile, reconcile::failed, context.clone())
        .for_each(|done| {
            if let Err(e) = done {
                tracing::warn!("{e}");
                if let controller::Error::QueueError(e) = &e {
                    context.metrics.watch_errors.inc();
                    context.watching.failed(e, Instant::now());
                }
            }
            futures::future::ready(())
        });
    tokio::select! {
        () = controller => {}
        done = tasks => anyhow::bail!("the task server ended: {done:?}"),
        done = &mut metrics => anyhow::bail!("the metrics server ended: {done:?}"),
    }
    // what was committed stays; workers wait for the next operator
    context.jobs.stop_all("the operator ends");
    for _ in 0..50 {
        if context.jobs.all().iter().all(|j| j.is_over()) {
            // nothing of ours writes any more: the next may begin at once
            lease.give_back().await;
            break;
        }
        tokio::time::sleep(std::time::Duration::from_millis(100)).await;
    }
    Ok(())
}

/// Labels our pod, which the service that workers know selects by.
async fn leads(context: &Context, leads: bool) -> anyhow::Result<()> {
    let pods: Api<Pod> = Api::namespaced(context.client.clone(), &context.config.namespace);
    let patch = json!({"metadata": {"labels": {LEADER: leads.then_some("true")}}});
    pods.patch(&context.config.pod, &PatchParams::default(), &Patch::Merge(&patch)).await?;
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
