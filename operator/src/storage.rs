//! The storage of a job: its profile, its servers and the nodes they are on, its credentials.

use std::collections::BTreeMap;

use k8s_openapi::ByteString;
use k8s_openapi::api::core::v1::{ConfigMap, Secret};
use k8s_openapi::api::discovery::v1::EndpointSlice;
use kube::api::ListParams;
use kube::{Api, Client};
use rayherd_api::{ByteSize, StorageSpec};
use rayherd_herd::remote::{Endpoint, Profile, Service, Storage};
use rayherd_herd::store::{S3Credentials, S3Key};

/// Why the storage cannot be used (yet).
#[derive(Debug, thiserror::Error)]
pub enum StorageError {
    /// Something that it names is not there.
    #[error("{0}")]
    Missing(String),
    /// The API server did not answer, or refused.
    #[error("cannot read {what}: {source}")]
    Api {
        /// What was read.
        what: String,
        /// Why not.
        source: kube::Error,
    },
}

/// Name of a profile's ConfigMap.
pub fn profile_name(spec: &StorageSpec) -> String {
    format!("rayherd-storage-{}", spec.profile.as_deref().unwrap_or("default"))
}
/// Name of a job's Secret.
pub fn secret_name(spec: &StorageSpec) -> String {
    spec.secret.clone().unwrap_or_else(|| "rayherd-storage".into())
}

/// Finds out the storage of a job.
pub async fn storage(client: &Client, own: &str, spec: &StorageSpec) -> Result<Storage, StorageError> {
    let name = profile_name(spec);
    let what = format!("ConfigMap {own}/{name}");
    let maps: Api<ConfigMap> = Api::namespaced(client.clone(), own);
    let map = maps.get_opt(&name).await.map_err(|source| StorageError::Api { what: what.clone(), source })?;
    let missing = |why: &str| StorageError::Missing(format!("{what} {why}"));
    let map = map.ok_or_else(|| missing("is not there: name another spec.storage.profile, or make it"))?;
    let text = map.data.unwrap_or_default().remove("profile.yaml").ok_or_else(|| missing("has no profile.yaml"))?;
    let profile: Profile =
        serde_yaml::from_str(&text).map_err(|e| missing(&format!("cannot be read: profile.yaml: {e}")))?;
    let mut endpoints = profile.endpoints.clone();
    if profile.distributed {
        endpoints =
            vec![profile.one_store().ok_or_else(|| missing("is distributed: give a service, or one endpoint"))?];
    } else if let Some(service) = &profile.service {
        let what = format!("EndpointSlices of {}/{}", service.namespace, service.name);
        let slices: Api<EndpointSlice> = Api::namespaced(client.clone(), &service.namespace);
        let params = ListParams::default().labels(&format!("kubernetes.io/service-name={}", service.name));
        let slices = slices.list(&params).await.map_err(|source| StorageError::Api { what, source })?;
        endpoints.extend(servers(&slices.items, service));
    }
    if endpoints.is_empty() {
        return Err(missing("names no server that is there"));
    }
    let region = profile.region.unwrap_or_else(|| "us-east-1".into());
    let Profile { bucket, prefix, identity, service_account, cache, .. } = profile;
    let cache = cache.map_or(0, ByteSize::bytes);
    Ok(Storage { bucket, prefix, region, endpoints, identity, service_account, cache })
}

/// Whether the storage has servers on nodes. One that is away just now is on none.
pub fn is_local(storage: &Storage) -> bool {
    storage.endpoints.iter().any(|e| e.node.is_some())
}

/// The servers of a StatefulSet in the order of their numbers, with the nodes that they run on now. One that is away has its place
/// all the same: it may be back, and what the others hold must not be looked for elsewhere meanwhile.
fn servers(slices: &[EndpointSlice], service: &Service) -> Vec<Endpoint> {
    let found = slices.iter().flat_map(|s| &s.endpoints);
    let nodes: BTreeMap<&str, &str> =
        found.filter_map(|e| Some((e.hostname.as_deref()?, e.node_name.as_deref()?))).collect();
    let Service { namespace, name, port, servers } = service;
    let server = |number| {
        let host = format!("{name}-{number}");
        let node = nodes.get(host.as_str()).map(|n| (*n).to_owned());
        Endpoint { url: format!("http://{host}.{name}.{namespace}.svc:{port}"), node }
    };
    (0..*servers).map(server).collect()
}

/// The credentials of a job whose storage was found: the operator's own identity, or the key in the Secret of the job's namespace.
pub async fn credentials(
    client: &Client,
    namespace: &str,
    spec: &StorageSpec,
    found: &Storage,
) -> Result<S3Credentials, StorageError> {
    if found.identity {
        let told = |e: rayherd_herd::store::StoreError| StorageError::Missing(format!("the operator: {e}"));
        return S3Credentials::identity().map_err(told);
    }
    let name = secret_name(spec);
    let what = format!("Secret {namespace}/{name}");
    let secrets: Api<Secret> = Api::namespaced(client.clone(), namespace);
    let secret = secrets.get_opt(&name).await.map_err(|source| StorageError::Api { what: what.clone(), source })?;
    let missing = |why: &str| StorageError::Missing(format!("{what} {why}"));
    let secret = secret.ok_or_else(|| missing("is not there: make it, or name another spec.storage.secret"))?;
    let data = secret.data.unwrap_or_default();
    let text = |key: &str| data.get(key).and_then(|ByteString(b)| String::from_utf8(b.clone()).ok());
    let need = |key: &str| text(key).ok_or_else(|| missing(&format!("has no {key}")));
    let key = S3Key {
        access_key: need("AWS_ACCESS_KEY_ID")?,
        secret_key: need("AWS_SECRET_ACCESS_KEY")?,
        session_token: text("AWS_SESSION_TOKEN"),
    };
    Ok(key.into())
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use hyper::{Request, Response};
    use kube::client::Body;
    use serde_json::json;

    use super::*;

    #[test]
    fn servers_keep_their_numbers() {
        let endpoint = |host: &str, node: &str| json!({"addresses": ["10.0.0.1"], "hostname": host, "nodeName": node});
        let slice = |endpoints: Vec<serde_json::Value>| -> EndpointSlice {
            serde_json::from_value(json!({"addressType": "IPv4", "metadata": {}, "endpoints": endpoints})).unwrap()
        };
        let slices = [slice(vec![endpoint("minio-2", "c")]), slice(vec![endpoint("minio-0", "b")])];
        let service = Service { namespace: "store".into(), name: "minio".into(), port: 9000, servers: 3 };
        let found = servers(&slices, &service);
        assert_eq!(found[1].url, "http://minio-1.minio.store.svc:9000");
        let nodes: Vec<Option<&str>> = found.iter().map(|e| e.node.as_deref()).collect();
        assert_eq!(nodes, [Some("b"), None, Some("c")]);
        let storage = |endpoints| Storage { bucket: "b".into(), region: "r".into(), endpoints, ..Storage::default() };
        assert!(is_local(&storage(found)), "the one that is away makes no other far");
        assert!(!is_local(&storage(vec![Endpoint { url: "https://s3".into(), node: None }])));
    }

    /// Whatever the environment of this process says: the same of the operator's identity as without a job, and no Secret is read.
    #[tokio::test]
    async fn a_storage_of_a_clouds_identity_needs_no_secret() {
        let (service, mut server) = tower_test::mock::pair::<Request<Body>, Response<Body>>();
        let client = Client::new(service, "default");
        let (spec, found) = (StorageSpec::default(), Storage { identity: true, ..Storage::default() });
        let told = credentials(&client, "studio", &spec, &found);
        let told = tokio::time::timeout(Duration::from_secs(20), told).await.expect("nobody is asked");
        let own = S3Credentials::identity().map_err(|e| format!("the operator: {e}"));
        assert_eq!(told.map_err(|e| e.to_string()), own);
        let asked = tokio::time::timeout(Duration::from_millis(100), server.next_request()).await;
        assert!(asked.is_err(), "a request to the API server");
        // without one it is read
        let of_key = Storage::default();
        let keys = credentials(&client, "studio", &spec, &of_key);
        tokio::select! {
            _ = keys => panic!("nobody has answered"),
            asked = server.next_request() => {
                assert!(asked.unwrap().0.uri().path().ends_with("/namespaces/studio/secrets/rayherd-storage"));
            }
        }
    }

    #[test]
    fn a_profile_has_a_cache_only_when_it_says_so() {
        let cache = |more: &str| {
            let profile = format!("bucket: herd\nendpoints: [{{url: 'https://s3'}}]\n{more}");
            serde_yaml::from_str::<Profile>(&profile).map(|p| p.cache.map(ByteSize::bytes))
        };
        assert_eq!((cache("").unwrap(), cache("cache: 20Gi").unwrap()), (None, Some(20 << 30)));
        assert!(cache("cache: large").unwrap_err().to_string().contains("is no size"));
    }
}
