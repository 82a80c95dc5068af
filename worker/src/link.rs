//! The way to the operator: JSON over HTTP, in TLS when the address says so.

use std::fs;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use rayherd_herd::remote::{Answer, Beat, Link, LinkError, Poll, Report};
use serde::Serialize;
use serde::de::DeserializeOwned;
use ureq::Agent;
use ureq::tls::{RootCerts, TlsConfig, TlsProvider};

use crate::config::Config;

/// Longer than the operator keeps a question open.
const POLL: Duration = Duration::from_secs(40);
const ANSWER: Duration = Duration::from_secs(15);
/// Most bytes of an answer: a task names its groups and camera units.
const MOST: u64 = 64 << 20;

/// The operator over HTTP.
pub struct Http {
    agent: Agent,
    base: String,
    token: Option<PathBuf>,
}

impl Http {
    /// For the operator and job of the settings.
    ///
    /// # Errors
    /// When the authority's certificate cannot be read.
    pub fn new(config: &Config) -> anyhow::Result<Self> {
        let mut builder = Agent::config_builder().http_status_as_error(false).timeout_connect(Some(ANSWER));
        if let Some(file) = &config.authority {
            let pem = fs::read(file).with_context(|| format!("cannot read {}", file.display()))?;
            let certificate = ureq::tls::Certificate::from_pem(&pem).context("RAYHERD_CA_FILE is no certificate")?;
            let tls = TlsConfig::builder()
                .provider(TlsProvider::Rustls)
                .root_certs(RootCerts::new_with_certs(&[certificate]))
                .unversioned_rustls_crypto_provider(Arc::new(rustls::crypto::ring::default_provider()))
                .build();
            builder = builder.tls_config(tls);
        }
        let base = format!("{}/v1/jobs/{}", config.operator, config.job);
        Ok(Http { agent: builder.build().into(), base, token: config.token.clone() })
    }

    fn ask<T: DeserializeOwned>(&self, what: &str, body: &impl Serialize, time: Duration) -> Result<T, LinkError> {
        let failed = |e: &dyn std::fmt::Display| LinkError(format!("{what}: {e}"));
        let mut request = self.agent.post(format!("{}/{what}", self.base));
        if let Some(file) = &self.token {
            // read anew: the kubelet renews it in place
            let token = fs::read_to_string(file).map_err(|e| failed(&e))?;
            request = request.header("authorization", format!("Bearer {}", token.trim()));
        }
        let request = request.config().timeout_global(Some(time)).build();
        let mut answer = request.send_json(body).map_err(|e| failed(&e))?;
        if answer.status().is_success() {
            let body = answer.body_mut().with_config().limit(MOST);
            return body.read_json().map_err(|e| failed(&e));
        }
        let said = answer.body_mut().with_config().limit(MOST).read_to_string().unwrap_or_default();
        Err(failed(&format!("{} {}", answer.status(), said.chars().take(300).collect::<String>())))
    }
}

impl Link for Http {
    fn poll(&self, poll: &Poll) -> Result<Answer, LinkError> {
        self.ask("poll", poll, POLL)
    }
    fn report(&self, report: &Report) -> Result<(), LinkError> {
        self.ask::<bool>("report", report, ANSWER).map(drop)
    }
    fn beat(&self, beat: &Beat) -> Result<Vec<String>, LinkError> {
        self.ask("beat", beat, ANSWER)
    }
}
