//! `helm test`: puts a Cornell box into the storage, has it rendered as anybody would, and looks at the picture's file.

use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use k8s_openapi::api::core::v1::Secret;
use kube::api::{DeleteParams, Patch, PatchParams};
use kube::{Api, Client};
use rayherd_api::StorageSpec;
use rayherd_api::resource::RenderJobObject;
use rayherd_herd::store::BlockStore;
use serde_json::json;

use crate::{run, storage};

const SCENE: &str = include_str!("../../examples/cornell-box.xml");
const NAME: &str = "rayherd-trial";
/// A small render, and pods that start meanwhile.
const PATIENCE: Duration = Duration::from_secs(300);
/// What every OpenEXR file begins with.
const EXR: [u8; 4] = [0x76, 0x2f, 0x31, 0x01];

/// Runs the trial.
pub async fn try_render() -> anyhow::Result<()> {
    let variable = |name: &str| std::env::var(name).with_context(|| format!("{name} is not set (the chart sets it)"));
    let (own, namespace) = (variable("RAYHERD_NAMESPACE")?, variable("RAYHERD_TRIAL_NAMESPACE")?);
    let profile = std::env::var("RAYHERD_TRIAL_PROFILE").ok().filter(|p| !p.is_empty());
    let client = Client::try_default().await?;
    let spec = StorageSpec { profile, ..StorageSpec::default() };
    let found = storage::storage(&client, &own, &spec).await?;
    if !found.identity {
        let secrets: Api<Secret> = Api::namespaced(client.clone(), &namespace);
        let name = storage::secret_name(&spec);
        if secrets.get_opt(&name).await?.is_none() {
            bail!("namespace {namespace} has no Secret {name}: make it, or set trial.namespace to one that has it");
        }
    }
    let depot = found.depot(None, &storage::credentials(&client, &namespace, &spec, &found).await?)?;
    let source = format!("scenes/{NAME}/cornell-box.xml");
    depot.replicated(2)?.put(&source, SCENE.into()).await.context("cannot put a scene into the storage")?;
    let jobs: Api<RenderJobObject> = Api::namespaced(client, &namespace);
    let job = json!({
        "apiVersion": rayherd_api::API_VERSION,
        "kind": rayherd_api::KIND,
        "metadata": {"name": NAME},
        "spec": {
            "scene": {"source": source},
            "image": {"size": "64x64"},
            "sampling": {"spp": 4, "maxDepth": 6},
            "workers": {"slots": [1], "memory": "64Mi"},
            "storage": spec,
        },
    });
    let job: RenderJobObject = serde_json::from_value(job)?;
    jobs.patch(NAME, &PatchParams::apply(NAME).force(), &Patch::Apply(&job)).await?;
    let end = wait(&jobs).await;
    let picture = async {
        let job = end?;
        let key = run::pictures(&job).pop().context("the job has no picture")?;
        let body = depot.replicated(1)?.get(&key).await.context("the picture is not where the job says")?;
        ensure!(body.starts_with(&EXR), "{key} is no OpenEXR file");
        println!("{key}: {} bytes, {}", body.len(), job.status.and_then(|s| s.progress).unwrap_or_default());
        anyhow::Ok(())
    };
    let done = picture.await;
    jobs.delete(NAME, &DeleteParams::default()).await?;
    done
}

async fn wait(jobs: &Api<RenderJobObject>) -> anyhow::Result<RenderJobObject> {
    let since = Instant::now();
    loop {
        let job = jobs.get(NAME).await?;
        let status = job.status.clone().unwrap_or_default();
        let current = status.observed_generation == job.metadata.generation;
        match status.phase.as_deref().filter(|_| current) {
            Some("Complete") => return Ok(job),
            Some("Failed") => {
                let why = status.conditions.into_iter().find(|c| c.type_ == "Failed").map(|c| c.message);
                bail!("the render failed: {}", why.unwrap_or_default());
            }
            phase => ensure!(since.elapsed() < PATIENCE, "not done within {PATIENCE:?}: it is {phase:?}"),
        }
        tokio::time::sleep(Duration::from_millis(500)).await;
    }
}
