//! Storage profiles: what a cluster's administrator writes down of a storage, and a job names.

use rayherd_api::ByteSize;
use serde::Deserialize;

use super::Endpoint;

/// A profile, as it stands in a ConfigMap under `profile.yaml`.
#[derive(Clone, Debug, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Profile {
    /// Name of the bucket in each server.
    pub bucket: String,
    /// Where in the bucket.
    #[serde(default)]
    pub prefix: String,
    /// Of the bucket.
    #[serde(default)]
    pub region: Option<String>,
    /// A headless service of a StatefulSet of the same name.
    #[serde(default)]
    pub service: Option<Service>,
    /// Servers by address.
    #[serde(default)]
    pub endpoints: Vec<Endpoint>,
    /// The servers are one store: what is put into one is in all (distributed MinIO, with erasure coding). It is reached by the service,
    /// nothing in it is near to any node, and it makes copies by itself.
    #[serde(default)]
    pub distributed: bool,
    /// No keys: the cloud says who the operator and the workers are, by their service accounts.
    #[serde(default)]
    pub identity: bool,
    /// The service account that workers run as, in the job's namespace.
    #[serde(default)]
    pub service_account: Option<String>,
    /// Disk beside each worker for copies of what it has read from servers on other machines.
    #[serde(default)]
    pub cache: Option<ByteSize>,
}

/// Servers by a headless service.
#[derive(Clone, Debug, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Service {
    /// Where it is.
    pub namespace: String,
    /// Its name, and the StatefulSet's.
    pub name: String,
    /// Of each server.
    #[serde(default = "default_port")]
    pub port: u16,
    /// How many; each keeps its number, there or not. Of a distributed one they are not told apart.
    #[serde(default)]
    pub servers: u32,
}

fn default_port() -> u16 {
    9000
}

impl Profile {
    /// A distributed store as the one server that it is; none when the profile names none, or several.
    pub fn one_store(&self) -> Option<Endpoint> {
        match (&self.service, &self.endpoints[..]) {
            (Some(Service { namespace, name, port, .. }), []) => {
                Some(Endpoint { url: format!("http://{name}.{namespace}.svc:{port}"), node: None })
            }
            (None, [one]) => Some(Endpoint { node: None, ..one.clone() }),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Servers that make copies by themselves are no places for ours.
    #[test]
    fn a_distributed_store_is_one_server_that_is_near_to_nobody() {
        let read = |text: &str| serde_json::from_str::<Profile>(text).unwrap();
        let service = r#"{"bucket": "herd", "distributed": true, "service": {"namespace": "store", "name": "minio"}}"#;
        let one = |url: &str| Some(Endpoint { url: url.into(), node: None });
        assert_eq!(read(service).one_store(), one("http://minio.store.svc:9000"));
        let address = r#"{"bucket": "herd", "distributed": true, "endpoints": [{"url": "https://s3", "node": "a"}]}"#;
        assert_eq!(read(address).one_store(), one("https://s3"));
        for none in
            [r#"{"bucket": "herd"}"#, r#"{"bucket": "herd", "endpoints": [{"url": "http://a"}, {"url": "http://b"}]}"#]
        {
            assert_eq!(read(none).one_store(), None);
        }
    }
}
