//! What the operator is told by its environment.

use std::net::SocketAddr;

use anyhow::Context;

/// Settings of the operator.
#[derive(Clone, Debug)]
pub struct Config {
    /// Its own namespace: where storage profiles are.
    pub namespace: String,
    /// Address by which workers reach the task server.
    pub url: String,
    /// Image of the workers.
    pub image: String,
    /// Where the task server listens.
    pub listen: SocketAddr,
    /// Where metrics are served.
    pub metrics: SocketAddr,
    /// The one namespace whose jobs are run; all if none.
    pub watch: Option<String>,
}

impl Config {
    /// From the environment.
    ///
    /// # Errors
    /// When a variable is missing or makes no sense; it is named.
    pub fn from_env() -> anyhow::Result<Self> {
        let variable = |name: &str| std::env::var(name).ok().filter(|v| !v.is_empty());
        let need = |name: &str| variable(name).with_context(|| format!("{name} is not set (the chart sets it)"));
        let address = |name: &str, default: &str| -> anyhow::Result<SocketAddr> {
            let text = variable(name).unwrap_or_else(|| default.into());
            text.parse().with_context(|| format!("{name} is {text:?}: give address:port"))
        };
        Ok(Config {
            namespace: need("RAYHERD_NAMESPACE")?,
            url: need("RAYHERD_URL")?,
            image: need("RAYHERD_WORKER_IMAGE")?,
            listen: address("RAYHERD_LISTEN", "0.0.0.0:8080")?,
            metrics: address("RAYHERD_METRICS", "0.0.0.0:9090")?,
            watch: variable("RAYHERD_WATCH_NAMESPACE"),
        })
    }
}
