//! A cluster's storage by address: what the operator finds out and hands to the workers.

use std::sync::Arc;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::Depot;
use crate::job::JobError;
use crate::store::{Patience, RetryPolicy, Retrying, S3Credentials, S3Settings, S3Store, TcpPulse, Watched};

/// To take a server's pulse: one packet may be lost, which a kernel sends again after 1 s.
const PULSE: Duration = Duration::from_secs(2);

/// A server of the storage.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Endpoint {
    /// `http://host:port`.
    pub url: String,
    /// The node that it runs on; none outside the cluster.
    pub node: Option<String>,
}

impl Endpoint {
    /// `host:port`, the port of the scheme where none is given.
    fn address(&self) -> String {
        let (scheme, rest) = self.url.split_once("://").unwrap_or(("http", &self.url));
        let host = rest.split('/').next().unwrap_or_default();
        let has_port =
            host.rsplit_once(':').is_some_and(|(_, p)| !p.is_empty() && p.bytes().all(|b| b.is_ascii_digit()));
        let port = if scheme == "https" { 443 } else { 80 };
        if has_port { host.to_owned() } else { format!("{host}:{port}") }
    }
}

/// All servers, in the order that everybody numbers them by, and where the data is in each.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Storage {
    /// Name of the bucket in each.
    pub bucket: String,
    /// Where in the bucket, without slashes at its ends.
    #[serde(default)]
    pub prefix: String,
    /// Region.
    #[serde(default = "default_region")]
    pub region: String,
    /// The servers.
    pub endpoints: Vec<Endpoint>,
    /// Whether a cloud says who the operator and the workers are; a key of the job's Secret does otherwise.
    #[serde(default)]
    pub identity: bool,
    /// The service account that workers run as, for that; the namespace's default one if none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub service_account: Option<String>,
    /// Bytes of a disk beside each worker that keep what it has read from servers on other machines; 0 for none.
    #[serde(default)]
    pub cache: u64,
}

fn default_region() -> String {
    "us-east-1".into()
}

impl Storage {
    /// The stores, as a machine on this node sees them.
    ///
    /// # Errors
    /// When an address cannot be used.
    pub fn depot(&self, node: Option<&str>, credentials: &S3Credentials) -> Result<Depot, JobError> {
        // what does not answer is read elsewhere: no long waiting for it
        let policy = RetryPolicy { attempts: 4, first: Duration::from_millis(100), longest: Duration::from_secs(1) };
        let open = |e: &Endpoint| {
            let settings = S3Settings {
                bucket: self.bucket.clone(),
                prefix: self.prefix.clone(),
                endpoint: Some(e.url.clone()),
                region: self.region.clone(),
                path_style: true,
                credentials: credentials.clone(),
            };
            let store = Retrying::new(Arc::new(S3Store::new(settings)?), policy);
            let pulse = TcpPulse { address: e.address(), longest: PULSE };
            Ok(Arc::new(Watched::new(Arc::new(store), Arc::new(pulse), Patience::default())))
        };
        let stores = self.endpoints.iter().map(open).collect::<Result<_, JobError>>()?;
        let home = self.endpoints.iter().position(|e| e.node.is_some() && e.node.as_deref() == node);
        Depot::watched(stores, home.map(|h| h as u32))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_endpoint_has_an_address_to_connect_to() {
        for (url, address) in [
            ("http://minio-0.minio.store.svc:9000", "minio-0.minio.store.svc:9000"),
            ("http://minio", "minio:80"),
            ("https://s3.example.com/", "s3.example.com:443"),
            ("http://[fd00::1]:9000/", "[fd00::1]:9000"),
            ("http://[fd00::a]", "[fd00::a]:80"),
        ] {
            assert_eq!(Endpoint { url: url.into(), node: None }.address(), address);
        }
    }
}
