//! A cluster's storage by address: what the operator finds out and hands to the workers.

use std::sync::Arc;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::Depot;
use crate::job::JobError;
use crate::store::{BlockStore, RetryPolicy, Retrying, S3Credentials, S3Settings, S3Store};

/// A server of the storage.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Endpoint {
    /// `http://host:port`.
    pub url: String,
    /// The node that it runs on; none outside the cluster.
    pub node: Option<String>,
}

/// All servers, in the order that everybody numbers them by, and where the data is in each.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
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
            Ok(Arc::new(Retrying::new(Arc::new(S3Store::new(settings)?), policy)) as Arc<dyn BlockStore>)
        };
        let stores = self.endpoints.iter().map(open).collect::<Result<_, JobError>>()?;
        let home = self.endpoints.iter().position(|e| e.node.is_some() && e.node.as_deref() == node);
        Depot::new(stores, home.map(|h| h as u32))
    }
}
