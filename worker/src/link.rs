//! The way to the operator: JSON over HTTP in TLS.

use std::fs;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use rayherd_herd::remote::{Answer, Beat, Link, LinkError, Poll, Report};
use serde::Serialize;
use serde::de::DeserializeOwned;
use ureq::Agent;
use ureq::tls::{PemItem, RootCerts, TlsConfig, TlsProvider, parse_pem};

use crate::config::Config;

/// Longer than the operator keeps a question open; a machine that is gone costs no more than this.
const POLL: Duration = Duration::from_secs(20);
const ANSWER: Duration = Duration::from_secs(15);
const CONNECT: Duration = Duration::from_secs(4);
/// Most bytes of an answer: a task names its groups and camera units.
const MOST: u64 = 64 << 20;

/// The operator over HTTP.
pub struct Http {
    agent: Agent,
    base: String,
    token: PathBuf,
}

impl Http {
    /// For the operator and job of the settings.
    ///
    /// # Errors
    /// When the operator's address is not one of TLS, or the authority's certificates cannot be read.
    pub fn new(config: &Config) -> anyhow::Result<Self> {
        anyhow::ensure!(config.operator.starts_with("https://"), "RAYHERD_OPERATOR is no https:// address");
        let mut trusted = Vec::new();
        for item in parse_pem(config.authority.as_bytes()) {
            if let PemItem::Certificate(certificate) = item.context("RAYHERD_CA is no certificate")? {
                trusted.push(certificate);
            }
        }
        anyhow::ensure!(!trusted.is_empty(), "RAYHERD_CA has no certificate");
        let tls = TlsConfig::builder()
            .provider(TlsProvider::Rustls)
            .root_certs(RootCerts::new_with_certs(&trusted))
            .unversioned_rustls_crypto_provider(Arc::new(rustls::crypto::ring::default_provider()))
            .build();
        let builder = Agent::config_builder()
            .http_status_as_error(false)
            .https_only(true)
            .timeout_connect(Some(CONNECT))
            .tls_config(tls);
        let base = format!("{}/v1/jobs/{}", config.operator, config.job);
        Ok(Http { agent: builder.build().into(), base, token: config.token.clone() })
    }

    fn ask<T: DeserializeOwned>(&self, what: &str, body: &impl Serialize, time: Duration) -> Result<T, LinkError> {
        let failed = |e: &dyn std::fmt::Display| LinkError(format!("{what}: {e}"));
        // read anew: the kubelet renews it in place
        let token = fs::read_to_string(&self.token).map_err(|e| failed(&e))?;
        let request = self.agent.post(format!("{}/{what}", self.base));
        let request = request.header("authorization", format!("Bearer {}", token.trim()));
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

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};
    use std::net::TcpListener;
    use std::path::Path;

    use rayherd_herd::remote::{Storage, WorkerId};
    use rayherd_herd::store::S3Key;
    use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};
    use rustls::pki_types::PrivatePkcs8KeyDer;
    use rustls::{ServerConfig, ServerConnection, Stream};

    use super::*;

    /// An authority's certificate, and a server of `localhost` that it has signed; the server answers every request with `[]`.
    fn serve() -> (String, u16) {
        let (key, mut params) = (KeyPair::generate().unwrap(), CertificateParams::new(vec![]).unwrap());
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let root = params.self_signed(&key).unwrap().pem();
        let own = KeyPair::generate().unwrap();
        let leaf = CertificateParams::new(vec!["localhost".into()]).unwrap();
        let leaf = leaf.signed_by(&own, &Issuer::new(params, key)).unwrap();
        let builder = ServerConfig::builder_with_provider(Arc::new(rustls::crypto::ring::default_provider()));
        let builder = builder.with_safe_default_protocol_versions().unwrap().with_no_client_auth();
        let private = PrivatePkcs8KeyDer::from(own.serialize_der()).into();
        let config = Arc::new(builder.with_single_cert(vec![leaf.der().clone()], private).unwrap());
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        std::thread::spawn(move || {
            for socket in listener.incoming() {
                let (mut socket, mut connection) = (socket.unwrap(), ServerConnection::new(config.clone()).unwrap());
                let mut stream = Stream::new(&mut connection, &mut socket);
                let mut request = [0; 4096];
                // who does not trust us says so instead of asking
                if matches!(stream.read(&mut request), Ok(n) if n > 0) {
                    let answer = "HTTP/1.1 200 OK\r\ncontent-type: application/json\r\ncontent-length: 2\r\nconnection: close\r\n\r\n[]";
                    stream.write_all(answer.as_bytes()).unwrap();
                }
            }
        });
        (root, port)
    }

    fn config(operator: String, authority: String, token: &Path) -> Config {
        Config {
            operator,
            job: "uid".into(),
            worker: WorkerId { number: 0, session: "s".into() },
            slots: 1,
            node: None,
            storage: Storage { bucket: "b".into(), region: "r".into(), ..Storage::default() },
            credentials: S3Key { access_key: String::new(), secret_key: String::new(), session_token: None }.into(),
            scratch: "/".into(),
            cache: None,
            token: token.to_owned(),
            authority,
        }
    }

    #[test]
    fn only_the_operator_of_our_authority_is_told_anything() {
        let ((ours, port), (others, _)) = (serve(), serve());
        let mut token = tempfile::NamedTempFile::new().unwrap();
        token.write_all(b"secret").unwrap();
        let token = token.path();
        let beat = Beat { worker: WorkerId { number: 0, session: "s".into() }, running: vec![] };
        let to =
            |authority: &str| Http::new(&config(format!("https://localhost:{port}"), authority.into(), token)).unwrap();
        assert_eq!(to(&ours).beat(&beat).unwrap(), Vec::<String>::new());
        assert_eq!(to(&format!("{others}{ours}")).beat(&beat).unwrap(), Vec::<String>::new(), "while roots change");
        let error = to(&others).beat(&beat).unwrap_err().to_string();
        assert!(error.contains("certificate"), "{error}");
        assert!(Http::new(&config(format!("http://localhost:{port}"), ours, token)).is_err(), "never without TLS");
        assert!(Http::new(&config(format!("https://localhost:{port}"), "nothing".into(), token)).is_err());
    }
}
