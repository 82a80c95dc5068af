//! What the operator is told by its environment.

use std::net::SocketAddr;

use anyhow::Context;

/// Settings of the operator.
#[derive(Clone, Debug)]
pub struct Config {
    /// Its own namespace: where storage profiles are.
    pub namespace: String,
    /// The pod that this is: its name in the lease.
    pub pod: String,
    /// Name of the lease.
    pub lease: String,
    /// Name of the Secret with the certificate authority.
    pub authority: String,
    /// Address by which workers reach the task server, `https://HOST:PORT`.
    pub url: String,
    /// Image of the workers.
    pub image: String,
    /// Where the task server listens.
    pub listen: SocketAddr,
    /// Where metrics are served.
    pub metrics: SocketAddr,
    /// The one namespace whose jobs are run; all if none.
    pub watch: Option<String>,
    /// Days after which a prepared scene goes that no job names or uses; 0 for never.
    pub scene_days: u32,
}

/// Unless the environment says otherwise.
const SCENE_DAYS: u32 = 30;
/// A hundred years.
const MOST_DAYS: u32 = 36_500;

impl Config {
    /// The host of [`Config::url`], which the task server's certificate is for.
    ///
    /// # Errors
    /// When the address is not one of TLS.
    pub fn host(&self) -> anyhow::Result<&str> {
        let rest = self.url.strip_prefix("https://").unwrap_or_default();
        let host = rest.split(['/', ':']).next().filter(|h| !h.is_empty());
        host.with_context(|| format!("RAYHERD_URL is {:?}: give https://HOST:PORT", self.url))
    }

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
        let days = variable("RAYHERD_SCENE_DAYS");
        let scene_days = days.as_ref().map_or(Ok(SCENE_DAYS), |text| text.parse()).ok().filter(|d| *d <= MOST_DAYS);
        let days = days.unwrap_or_default();
        Ok(Config {
            namespace: need("RAYHERD_NAMESPACE")?,
            pod: need("RAYHERD_POD")?,
            lease: need("RAYHERD_LEASE")?,
            authority: need("RAYHERD_AUTHORITY")?,
            url: need("RAYHERD_URL")?,
            image: need("RAYHERD_WORKER_IMAGE")?,
            listen: address("RAYHERD_LISTEN", "0.0.0.0:8443")?,
            metrics: address("RAYHERD_METRICS", "0.0.0.0:9090")?,
            watch: variable("RAYHERD_WATCH_NAMESPACE"),
            scene_days: scene_days.with_context(|| {
                format!("RAYHERD_SCENE_DAYS is {days:?}: give days from 1 to {MOST_DAYS}, or 0 to keep prepared scenes for ever")
            })?,
        })
    }
}
