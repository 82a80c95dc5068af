//! The storage of a cluster's job from this machine: its profile, and its scene.

use std::path::{Path, PathBuf};

use anyhow::Context;
use rayherd_herd::remote::{Endpoint, Profile, Storage, download};
use rayherd_herd::store::S3Credentials;
use serde::Deserialize;
use tempfile::TempDir;

use crate::bounded;
use crate::fault::Mistake;
use crate::interrupt;

/// Most bytes of a profile: it names a few servers.
const MOST_BYTES: u64 = 1 << 20;

/// A ConfigMap of the chart, as far as it matters.
#[derive(Deserialize)]
struct ConfigMap {
    data: Data,
}

#[derive(Deserialize)]
struct Data {
    #[serde(rename = "profile.yaml")]
    profile: String,
}

/// A source that was copied here; it goes with this value.
pub struct Fetched {
    /// Where it is now.
    pub source: PathBuf,
    _folder: TempDir,
}

/// Copies the source of a job and what lies beside it from the storage of a profile, as a worker that prepares it does: the scene has the
/// same fingerprint. Keys come from the environment. `endpoint` stands for servers that only the cluster can reach.
pub fn fetch(profile: &Path, endpoint: Option<&str>, source: &str) -> anyhow::Result<Fetched> {
    let storage = storage(profile, endpoint)?;
    let credentials = S3Credentials::from_env().map_err(Mistake)?;
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
    let runtime = runtime.context("cannot start a thread for input and output")?;
    let folder = tempfile::tempdir().context("cannot make a temporary folder (TMPDIR)")?;
    interrupt::remove_at_end(folder.path());
    let view = storage.depot(None, &credentials)?.replicated(1)?;
    let source = download(&view, runtime.handle(), source, folder.path())
        .with_context(|| format!("cannot fetch the scene of {}", profile.display()))?;
    Ok(Fetched { source, _folder: folder })
}

fn storage(path: &Path, endpoint: Option<&str>) -> Result<Storage, Mistake> {
    let wrong = |why: String| Mistake(format!("{}: {why}", path.display()));
    let text = bounded::read(path, MOST_BYTES, "this is no storage profile")?;
    // as kubectl get configmap -o yaml prints it, or what is in it
    let map: Option<ConfigMap> = serde_yaml::from_slice(&text).ok();
    let text = map.map_or(text, |map| map.data.profile.into_bytes());
    let profile: Profile =
        serde_yaml::from_slice(&text).map_err(|e| wrong(format!("this is no storage profile: {e}")))?;
    let server = |url: &str| Endpoint { url: url.trim_end_matches('/').to_owned(), node: None };
    let endpoints = match endpoint {
        Some(url) => vec![server(url)],
        None => profile.endpoints.iter().map(|e| server(&e.url)).collect(),
    };
    if endpoints.is_empty() {
        let told =
            "its servers are a service inside the cluster: name one that this machine reaches with --s3-endpoint";
        return Err(wrong(told.to_owned()));
    }
    let Profile { bucket, prefix, region, .. } = profile;
    let region = region.unwrap_or_else(|| "us-east-1".into());
    Ok(Storage { bucket, prefix, region, endpoints, ..Storage::default() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_profile_is_a_file_of_its_own_or_in_a_config_map() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("p.yaml");
        let read = |text: &str, endpoint| {
            std::fs::write(&path, text).unwrap();
            storage(&path, endpoint).map_err(|e| e.to_string())
        };
        let outside = "{bucket: herd, prefix: a, endpoints: [{url: 'https://s3.example.com/', node: n}]}";
        let found = read(outside, None).unwrap();
        assert_eq!((found.bucket.as_str(), found.prefix.as_str(), found.region.as_str()), ("herd", "a", "us-east-1"));
        assert_eq!(found.endpoints, [Endpoint { url: "https://s3.example.com".into(), node: None }]);
        let map = format!("kind: ConfigMap\nmetadata: {{name: x}}\ndata:\n  profile.yaml: |\n    {outside}\n");
        assert_eq!(read(&map, None).unwrap(), found);
        let inside = "{bucket: herd, service: {namespace: store, name: minio, servers: 3}}";
        assert!(read(inside, None).unwrap_err().contains("--s3-endpoint"));
        assert_eq!(read(inside, Some("http://localhost:9000")).unwrap().endpoints[0].url, "http://localhost:9000");
        for wrong in ["{bucket: herd, serivce: {}}", "[1]", ""] {
            assert!(read(wrong, None).unwrap_err().contains("no storage profile"), "{wrong}");
        }
    }
}
