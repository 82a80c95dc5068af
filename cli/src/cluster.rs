//! Jobs on a Kubernetes cluster, by the conventions of kubectl. Only this module knows Kubernetes.

use std::collections::BTreeSet;
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use futures::{AsyncBufReadExt, TryStreamExt};
use k8s_openapi::api::core::v1::Pod;
use k8s_openapi::jiff::Timestamp;
use kube::api::{ApiResource, DynamicObject, ListParams, LogParams, Patch, PatchParams};
use kube::config::{KubeConfigOptions, Kubeconfig};
use kube::{Api, Client, Config, ResourceExt};
use rayherd_api::RenderJob;
use rayherd_api::resource::{RenderJobObject, RenderJobStatus};
use rustls::crypto::ring::default_provider;
use tokio::runtime::Runtime;
use tokio::sync::mpsc;
use tokio::time::{Instant, timeout_at};

use crate::fault::Mistake;

/// Field manager of what is submitted.
const MANAGER: &str = "rayherd";
/// The label of a job's pods; its value is the job's uid.
const LABEL: &str = "rayherd.io/job";
/// The number of a worker.
const NUMBER: &str = "rayherd.io/worker";
/// Between two looks for workers whose log is not followed yet.
const LOOK: Duration = Duration::from_secs(1);
/// Lines of logs that wait to be printed.
const WAITING: usize = 1024;

/// Which cluster, and where in it.
#[derive(Args)]
#[command(next_help_heading = "Cluster")]
pub struct ClusterOptions {
    /// Namespace [default: the context's, or default]
    #[arg(short, long, value_name = "NAME")]
    namespace: Option<String>,
    /// Context of the kubeconfig (KUBECONFIG, or ~/.kube/config) [default: the current one]
    #[arg(long, value_name = "NAME")]
    context: Option<String>,
}

/// A cluster.
pub struct Cluster {
    client: Client,
    namespace: String,
    runtime: Runtime,
}

/// A job, as it is shown.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Shown {
    /// Where it is.
    pub namespace: String,
    /// Its name.
    pub name: String,
    /// What no other job has, of whatever name.
    pub uid: String,
    /// `Rendering`, `Complete`, ...: of the spec as it stands now.
    pub phase: String,
    /// Samples made of those asked for.
    pub progress: String,
    /// Estimated relMSE.
    pub error: String,
    /// Share of scene bytes read from other nodes.
    pub remote: String,
    /// Workers there, of those wanted.
    pub workers: String,
    /// How old it is.
    pub age: String,
    /// What is wrong with it, if it failed.
    pub why: Option<String>,
}

impl Cluster {
    /// Connects, as kubectl would.
    ///
    /// # Errors
    /// When there is no kubeconfig, or it names no such context.
    pub fn connect(options: &ClusterOptions) -> anyhow::Result<Self> {
        // one provider for every TLS connection of the process; set already by an earlier call
        let _ = default_provider().install_default();
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
        let runtime = runtime.context("cannot start a thread for input and output")?;
        let hint = "set KUBECONFIG, or have a ~/.kube/config that names the cluster";
        let config = match &options.context {
            Some(context) => runtime.block_on(async {
                let all = Kubeconfig::read().map_err(|e| Mistake(format!("{e}: {hint}")))?;
                let options = KubeConfigOptions { context: Some(context.clone()), ..KubeConfigOptions::default() };
                let found = Config::from_custom_kubeconfig(all, &options).await;
                found.map_err(|e| anyhow::Error::from(Mistake(format!("context {context}: {e}"))))
            })?,
            None => runtime.block_on(Config::infer()).map_err(|e| Mistake(format!("{e}: {hint}")))?,
        };
        let namespace = options.namespace.clone().unwrap_or_else(|| config.default_namespace.clone());
        let client = runtime.block_on(async { Client::try_from(config) })?;
        Ok(Cluster { client, namespace, runtime })
    }

    /// As the API server has them: one whose spec nobody can read must not hide the others.
    fn api(&self) -> Api<DynamicObject> {
        Api::namespaced_with(self.client.clone(), &self.namespace, &kind())
    }

    /// The namespace that is worked in.
    pub fn namespace(&self) -> &str {
        &self.namespace
    }

    /// Makes a job, or changes the one of its name.
    ///
    /// # Errors
    /// When the API server does not take it: its message says why.
    pub fn apply(&self, job: &RenderJob) -> anyhow::Result<()> {
        let name = job.metadata.name.as_deref().unwrap_or_default();
        let params = PatchParams::apply(MANAGER).force();
        let done = self.runtime.block_on(self.api().patch(name, &params, &Patch::Apply(job)));
        done.map(drop).map_err(|e| self.told(e, &format!("renderjob {name} is not taken")))
    }

    /// A job.
    ///
    /// # Errors
    /// When there is none of this name.
    pub fn job(&self, name: &str) -> anyhow::Result<Shown> {
        let job = self.runtime.block_on(self.api().get(name));
        job.map(|j| shown(&j)).map_err(|e| self.told(e, &format!("renderjob {name}")))
    }

    /// All jobs, of the namespace or of all.
    ///
    /// # Errors
    /// When the API server does not list them.
    pub fn jobs(&self, everywhere: bool) -> anyhow::Result<Vec<Shown>> {
        let api = if everywhere { Api::all_with(self.client.clone(), &kind()) } else { self.api() };
        let listed = self.runtime.block_on(api.list(&ListParams::default()));
        let mut jobs: Vec<Shown> = listed.map_err(|e| self.told(e, "renderjobs"))?.iter().map(shown).collect();
        jobs.sort_by(|a, b| (&a.namespace, &a.name).cmp(&(&b.namespace, &b.name)));
        Ok(jobs)
    }

    /// The logs of a job's workers: name of the pod and text, by worker.
    ///
    /// # Errors
    /// When there is no such job, or its pods' logs are refused.
    pub fn logs(&self, name: &str, tail: Option<i64>) -> anyhow::Result<Vec<(String, String)>> {
        let read = async {
            let job = self.api().get(name).await?;
            let pods: Api<Pod> = Api::namespaced(self.client.clone(), &self.namespace);
            let label = format!("{LABEL}={}", job.metadata.uid.unwrap_or_default());
            let mut found = pods.list(&ListParams::default().labels(&label)).await?.items;
            found.sort_by_key(|p| (p.labels().get(NUMBER).and_then(|n| n.parse::<u32>().ok()), p.name_any()));
            let mut logs = Vec::new();
            let params = LogParams { tail_lines: tail, container: Some("worker".into()), ..LogParams::default() };
            for pod in found {
                let text = match pods.logs(&pod.name_any(), &params).await {
                    Ok(text) => text,
                    // a container that has not begun has no log yet
                    Err(kube::Error::Api(e)) if e.code == 400 => format!("({})\n", e.message),
                    Err(kube::Error::Api(e)) if e.code == 404 => continue,
                    Err(e) => return Err(e),
                };
                logs.push((pod.name_any(), text));
            }
            Ok(logs)
        };
        self.runtime.block_on(read).map_err(|e: kube::Error| self.told(e, &format!("logs of renderjob {name}")))
    }

    /// Hands on what a job's workers say while they say it: name of the pod and line. A worker that begins anew is followed anew; the end is
    /// there when the job is done, or deleted, and no worker says anything any more, or when `hand_on` says that it wants no more.
    ///
    /// # Errors
    /// When there is no such job, its pods' logs are refused, or the line cannot be handed on.
    pub fn follow(
        &self,
        name: &str,
        tail: Option<i64>,
        mut hand_on: impl FnMut(&str, &str) -> anyhow::Result<bool>,
    ) -> anyhow::Result<()> {
        let what = format!("logs of renderjob {name}");
        let pods: Api<Pod> = Api::namespaced(self.client.clone(), &self.namespace);
        let (send, mut lines) = mpsc::channel::<(String, String)>(WAITING);
        self.runtime.block_on(async {
            let job = self.api().get(name).await.map_err(|e| self.told(e, &format!("renderjob {name}")))?;
            let uid = job.metadata.uid.unwrap_or_default();
            let label = format!("{LABEL}={uid}");
            let mut begun = BTreeSet::new();
            let mut streams = tokio::task::JoinSet::new();
            loop {
                // asked before the pods: what a job that is done has started is seen below
                let job = self.api().get_opt(name).await.map_err(|e| self.told(e, &what))?;
                let job = job.filter(|j| j.metadata.uid.as_deref() == Some(&uid));
                let over = job.is_none_or(|j| matches!(shown(&j).phase.as_str(), "Complete" | "Failed"));
                let found = pods.list(&ListParams::default().labels(&label)).await.map_err(|e| self.told(e, &what))?;
                for pod in &found.items {
                    let Some(container) = container_begun(pod).filter(|c| begun.insert(c.clone())) else { continue };
                    tracing::debug!(pod = pod.name_any(), container, "following");
                    let params = LogParams {
                        follow: true,
                        tail_lines: tail,
                        container: Some("worker".into()),
                        ..LogParams::default()
                    };
                    streams.spawn(pass_on(pods.clone(), pod.name_any(), params, send.clone()));
                }
                let end = Instant::now() + LOOK;
                while let Ok(Some((pod, line))) = timeout_at(end, lines.recv()).await {
                    if !hand_on(&pod, &line)? {
                        return Ok(());
                    }
                }
                while let Some(ended) = streams.try_join_next() {
                    ended.context("a log's reader panicked")?.map_err(|e| self.told(e, &what))?;
                }
                if over && streams.is_empty() && lines.is_empty() {
                    return Ok(());
                }
            }
        })
    }

    /// What the user can put right is told as that.
    fn told(&self, error: kube::Error, what: &str) -> anyhow::Error {
        match error {
            kube::Error::Api(e) if e.code == 404 && e.message.contains("could not find the requested resource") => Mistake(
                "the cluster knows no RenderJob: kubectl apply --server-side -f crds/renderjob.yaml, and install the chart".into(),
            )
            .into(),
            kube::Error::Api(e) if (400..500).contains(&e.code) => {
                Mistake(format!("{what}: {} (namespace {})", e.message, self.namespace)).into()
            }
            e => anyhow::Error::new(e).context(format!("{what}: the API server does not do it")),
        }
    }
}

/// The container of a worker that runs, or has run, by its id: another one after each start.
fn container_begun(pod: &Pod) -> Option<String> {
    let all = pod.status.as_ref()?.container_statuses.as_ref()?;
    let worker = all.iter().find(|c| c.name == "worker")?;
    let state = worker.state.as_ref()?;
    (state.running.is_some() || state.terminated.is_some()).then(|| worker.container_id.clone()).flatten()
}

/// Reads a log to its end, which comes with that of the container.
async fn pass_on(
    pods: Api<Pod>,
    pod: String,
    params: LogParams,
    to: mpsc::Sender<(String, String)>,
) -> kube::Result<()> {
    let stream = match pods.log_stream(&pod, &params).await {
        Ok(stream) => stream,
        // deleted meanwhile, with its log
        Err(kube::Error::Api(e)) if matches!(e.code, 400 | 404) => return Ok(()),
        Err(e) => return Err(e),
    };
    let mut lines = std::pin::pin!(stream.lines());
    loop {
        match lines.try_next().await {
            Ok(Some(line)) => {
                if to.send((pod.clone(), line)).await.is_err() {
                    return Ok(());
                }
            }
            Ok(None) => return Ok(()),
            // its node went away
            Err(e) => {
                tracing::warn!("{pod}: its log breaks off: {e}");
                return Ok(());
            }
        }
    }
}

fn kind() -> ApiResource {
    ApiResource::erase::<RenderJobObject>(&())
}

fn shown(job: &DynamicObject) -> Shown {
    // one of another version says nothing
    let status: RenderJobStatus = serde_json::from_value(job.data["status"].clone()).unwrap_or_default();
    let current = status.observed_generation == job.metadata.generation;
    let failed = status.conditions.iter().find(|c| c.type_ == "Failed" && c.status == "True" && current);
    let age = job.metadata.creation_timestamp.as_ref();
    Shown {
        namespace: job.namespace().unwrap_or_default(),
        name: job.name_any(),
        uid: job.metadata.uid.clone().unwrap_or_default(),
        phase: status.phase.filter(|_| current).unwrap_or_else(|| "Pending".into()),
        progress: status.progress.unwrap_or_default(),
        error: status.rel_mse.unwrap_or_default(),
        remote: status.remote_read_ratio.unwrap_or_default(),
        workers: status.workers.unwrap_or_default(),
        age: age.map(|t| short(Timestamp::now().duration_since(t.0).as_secs())).unwrap_or_default(),
        why: failed.map(|c| c.message.clone()),
    }
}

/// A time as kubectl shows it: in its largest whole unit.
fn short(seconds: i64) -> String {
    match seconds.max(0) {
        s @ ..=119 => format!("{s}s"),
        s @ ..=7199 => format!("{}m", s / 60),
        s @ ..=172_799 => format!("{}h", s / 3600),
        s => format!("{}d", s / 86_400),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_job_is_shown_as_its_spec_stands_now() {
        let job = |observed: i64| -> DynamicObject {
            serde_json::from_value(serde_json::json!({
                "apiVersion": "rayherd.io/v1alpha1",
                "kind": "RenderJob",
                "metadata": {"name": "box", "namespace": "studio", "generation": 2},
                "spec": {"scene": {"source": "a/b.xml"}, "workers": {"memory": "99999999999E"}},
                "status": {"phase": "Failed", "observedGeneration": observed, "progress": "40%", "conditions": [{
                    "type": "Failed", "status": "True", "reason": "CannotRender", "message": "no",
                    "lastTransitionTime": "2026-01-01T00:00:00Z",
                }]},
            }))
            .unwrap()
        };
        let now = shown(&job(2));
        assert_eq!((now.phase.as_str(), now.why.as_deref(), now.progress.as_str()), ("Failed", Some("no"), "40%"));
        let changed = shown(&job(1));
        assert_eq!((changed.phase.as_str(), changed.why), ("Pending", None));
        assert_eq!([5, 119, 120, 7199, 7200, 200_000].map(short), ["5s", "119s", "2m", "119m", "2h", "2d"]);
    }

    #[test]
    fn a_container_is_followed_when_it_has_begun_and_anew_when_it_begins_anew() {
        let pod = |state: serde_json::Value, id: &str| -> Pod {
            let status = serde_json::json!({"name": "worker", "state": state, "containerID": id, "image": "", "imageID": "",
                "ready": true, "restartCount": 0});
            let beside = serde_json::json!({"name": "beside", "state": {"running": {}}, "containerID": "b", "image": "",
                "imageID": "", "ready": true, "restartCount": 0});
            serde_json::from_value(
                serde_json::json!({"metadata": {}, "status": {"containerStatuses": [beside, status]}}),
            )
            .unwrap()
        };
        assert_eq!(container_begun(&pod(serde_json::json!({"waiting": {}}), "")), None);
        assert_eq!(container_begun(&Pod::default()), None);
        assert_eq!(container_begun(&pod(serde_json::json!({"running": {}}), "a")).as_deref(), Some("a"));
        let ended = serde_json::json!({"terminated": {"exitCode": 1}});
        assert_eq!(container_begun(&pod(ended, "c")).as_deref(), Some("c"));
    }
}
