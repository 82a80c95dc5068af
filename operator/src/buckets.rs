//! The chart's hook: makes the buckets in each of its MinIOs, which may only just be starting.

use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use rayherd_herd::store::{S3Settings, S3Store, StoreError};

/// For servers that start, and volumes that are made for them.
const PATIENCE: Duration = Duration::from_secs(600);
/// Between two tries.
const PAUSE: Duration = Duration::from_secs(1);

/// Makes the buckets in `RAYHERD_BUCKETS` (names with commas between them) in each server.
///
/// # Errors
/// When a name or an address cannot be used, or a server refuses, or does not answer for long.
pub async fn make(servers: &[String]) -> anyhow::Result<()> {
    let names = std::env::var("RAYHERD_BUCKETS").context("RAYHERD_BUCKETS is not set (the chart sets it)")?;
    ensure!(!servers.is_empty(), "no server: rayherd-operator buckets http://HOST:PORT ...");
    let until = Instant::now() + PATIENCE;
    for server in servers {
        for name in names.split(',').filter(|n| !n.is_empty()) {
            let settings = S3Settings::from_url(&format!("s3://{name}"), Some(server))?;
            make_one(&S3Store::new(settings)?, until).await.with_context(|| server.clone())?;
            tracing::info!("{server} has a bucket {name}");
        }
    }
    Ok(())
}

async fn make_one(store: &S3Store, until: Instant) -> Result<(), StoreError> {
    loop {
        match store.make_bucket().await {
            Err(StoreError::Unavailable { message, .. }) if Instant::now() < until => {
                tracing::info!("not yet: {message}");
                tokio::time::sleep(PAUSE).await;
            }
            done => return done,
        }
    }
}
