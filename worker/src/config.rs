//! What the operator tells a worker by its environment.

use std::path::PathBuf;
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::Context;
use rayherd_herd::remote::{Storage, WorkerId};
use rayherd_herd::store::{S3Credentials, S3Key};

/// Settings of a worker.
pub struct Config {
    /// Address of the operator's task server.
    pub operator: String,
    /// The job, by its uid.
    pub job: String,
    /// Who this is.
    pub worker: WorkerId,
    /// Tasks at a time.
    pub slots: u32,
    /// Name of the node.
    pub node: Option<String>,
    /// Where everything is.
    pub storage: Storage,
    /// As whom.
    pub credentials: S3Credentials,
    /// A folder of its own.
    pub scratch: PathBuf,
    /// Where its cache is, if the storage's profile gives it one.
    pub cache: Option<PathBuf>,
    /// The token that proves which pod this is; it is renewed in place.
    pub token: PathBuf,
    /// Certificates of the authority that the operator's is signed by, as PEM. No other is trusted.
    pub authority: String,
}

impl Config {
    /// From the environment.
    ///
    /// # Errors
    /// When a variable is missing or makes no sense; it is named.
    pub fn from_env() -> anyhow::Result<Self> {
        Self::from(|name| std::env::var(name).ok().filter(|v| !v.is_empty()))
    }

    fn from(variable: impl Fn(&str) -> Option<String>) -> anyhow::Result<Self> {
        let need = |name: &str| {
            variable(name)
                .with_context(|| format!("{name} is not set: workers are started by the operator, not by hand"))
        };
        let number =
            |name: &str| -> anyhow::Result<u32> { need(name)?.parse().with_context(|| format!("{name} is no number")) };
        let nanos = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos());
        // a container that starts again in its pod is another session
        let session = format!("{}-{nanos:x}", need("RAYHERD_POD")?);
        let storage: Storage =
            serde_json::from_str(&need("RAYHERD_STORAGE")?).context("RAYHERD_STORAGE cannot be read")?;
        let credentials = match storage.identity {
            true => S3Credentials::identity()?,
            false => S3Credentials::Key(S3Key {
                access_key: need("AWS_ACCESS_KEY_ID")?,
                secret_key: need("AWS_SECRET_ACCESS_KEY")?,
                session_token: variable("AWS_SESSION_TOKEN"),
            }),
        };
        Ok(Config {
            operator: need("RAYHERD_OPERATOR")?.trim_end_matches('/').to_owned(),
            job: need("RAYHERD_JOB")?,
            worker: WorkerId { number: number("RAYHERD_WORKER")?, session },
            slots: number("RAYHERD_SLOTS")?,
            node: variable("RAYHERD_NODE"),
            storage,
            credentials,
            scratch: need("RAYHERD_SCRATCH")?.into(),
            cache: variable("RAYHERD_CACHE").map(PathBuf::from),
            token: need("RAYHERD_TOKEN_FILE")?.into(),
            authority: need("RAYHERD_CA")?,
        })
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    fn full() -> BTreeMap<&'static str, &'static str> {
        BTreeMap::from([
            ("RAYHERD_POD", "a-w1"),
            ("RAYHERD_OPERATOR", "https://operator:8443/"),
            ("RAYHERD_JOB", "uid"),
            ("RAYHERD_WORKER", "1"),
            ("RAYHERD_SLOTS", "2"),
            ("RAYHERD_NODE", "node1"),
            (
                "RAYHERD_STORAGE",
                r#"{"bucket":"herd","endpoints":[{"url":"http://minio-0.minio:9000","node":"node1"}]}"#,
            ),
            ("AWS_ACCESS_KEY_ID", "a"),
            ("AWS_SECRET_ACCESS_KEY", "b"),
            ("RAYHERD_SCRATCH", "/scratch"),
            ("RAYHERD_TOKEN_FILE", "/token"),
            ("RAYHERD_CA", "PEM"),
        ])
    }

    #[test]
    fn what_is_missing_is_named() {
        let config = Config::from(|n| full().get(n).map(|v| (*v).to_owned())).unwrap();
        assert_eq!((config.worker.number, config.slots, config.operator.as_str()), (1, 2, "https://operator:8443"));
        assert_eq!(config.storage.depot(config.node.as_deref(), &config.credentials).unwrap().home(), Some(0));
        assert_eq!((config.cache, config.storage.cache), (None, 0), "as an operator without caches says it");
        for name in full().keys().filter(|n| **n != "RAYHERD_NODE") {
            let error = Config::from(|n| full().get(n).filter(|_| n != *name).map(|v| (*v).to_owned())).err().unwrap();
            assert!(error.to_string().contains(name), "{error}");
        }
    }
}
