//! One step towards what a RenderJob asks for: look, decide, apply, tell.

use std::collections::BTreeSet;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, Instant};

use futures::channel::mpsc::UnboundedSender;
use k8s_openapi::NamespaceResourceScope;
use k8s_openapi::api::core::v1::Pod;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use k8s_openapi::jiff::{SignedDuration, Timestamp};
use kube::api::{
    ApiResource, DeleteParams, DynamicObject, ListParams, Patch, PatchParams, Preconditions, ValidationDirective,
};
use kube::core::DeserializeGuard;
use kube::core::error_boundary::InvalidObject;
use kube::runtime::controller::Action;
use kube::runtime::events::{Event, EventType, Recorder, Reporter};
use kube::runtime::reflector::ObjectRef;
use kube::{Api, Client, Resource, ResourceExt};
use rayherd_api::resource::{RenderJobObject, RenderJobStatus};
use rayherd_api::{MANAGED_BY, PREVIEW, Placement, RenderJobSpec, validate};
use rayherd_herd::remote::{Storage, Turns};
use rayherd_herd::store::StoreError;
use serde_json::json;

use crate::backoff::Failures;
use crate::build::{self, Lies};
use crate::config::Config;
use crate::finish::{self, Leftovers};
use crate::jobs::{Jobs, Running, State};
use crate::kills::{Kill, kills};
use crate::metrics::Metrics;
use crate::retention::Storages;
use crate::run;
use crate::status;
use crate::storage::{self, StorageError};
use crate::trigger::Wake;
use crate::watching::Watching;

/// Field manager of everything but the ledger's pointers.
const MANAGER: &str = "rayherd-operator";
/// Objects of a job that Kubernetes does not know of: those in the storage.
pub const FINALIZER: &str = "rayherd.io/storage";
/// Most bytes of an event's note that the API server takes.
const MOST_NOTE: usize = 1024;
/// Between two looks at a job that runs.
const LOOK: Duration = Duration::from_secs(1);
/// Before it is looked again whether a job that was stopped has stopped.
const SOON: Duration = Duration::from_millis(200);
/// A known scene is found within this time, or prepared again.
const LOOK_UP: SignedDuration = SignedDuration::from_secs(5);
/// Workers are put beside the job's scene, and whoever is to prepare it beside its source, if it is known where that lies within this time after the
/// job began: it takes a few requests to each server, and longer only where one hangs.
const SOUGHT: SignedDuration = SignedDuration::from_secs(2);
const SEEKING: Duration = Duration::from_millis(10);
/// A pod that is to end is taken for ended so long after its grace period, when its node does not say: it may be gone for good.
const SILENT: SignedDuration = SignedDuration::from_secs(30);
/// After the first failure of a job, before it is looked at again.
const FAILED: Duration = Duration::from_secs(3);
/// After the first pod of a worker that failed, or was refused, before another is made.
const NO_POD: Duration = Duration::from_secs(1);
/// A worker whose pod runs for so long is well.
const WELL: SignedDuration = SignedDuration::from_secs(300);
/// Before a job whose surroundings are not there (yet) is looked at again.
const AGAIN: Duration = Duration::from_secs(10);

/// What reconciling works with.
pub struct Context {
    /// The API server.
    pub client: Client,
    /// Settings.
    pub config: Config,
    /// Jobs that run here.
    pub jobs: Jobs,
    /// The certificates that workers trust, as PEM; empty until the authority is loaded.
    pub trusted: RwLock<String>,
    /// Who prepares which scene.
    pub turns: Arc<Turns>,
    /// What is left of deleted jobs in storages whose servers were away.
    pub left: Arc<Leftovers>,
    /// Storages that jobs have used.
    pub storages: Storages,
    /// Steps that failed in a row, by job.
    pub failures: Failures,
    /// Whether what happens is still seen.
    pub watching: Watching,
    /// What a person would want to know.
    pub events: Recorder,
    /// Counts.
    pub metrics: Metrics,
    /// Jobs that are to be looked at before their next turn.
    pub steps: UnboundedSender<ObjectRef<Seen>>,
}

impl Context {
    /// Nothing runs yet.
    pub fn new(client: Client, config: Config, metrics: Metrics, steps: UnboundedSender<ObjectRef<Seen>>) -> Self {
        let (jobs, trusted, turns, left) = (Jobs::default(), RwLock::default(), Arc::default(), Arc::default());
        let reporter = Reporter { controller: "rayherd-operator".into(), instance: Some(config.pod.clone()) };
        let events = Recorder::new(client.clone(), reporter);
        let (storages, failures, watching) = (Storages::default(), Failures::default(), Watching::default());
        Context { client, config, jobs, trusted, turns, left, storages, failures, watching, events, metrics, steps }
    }
    /// Objects of every namespace that is watched.
    pub fn everywhere<K>(&self) -> Api<K>
    where
        K: Resource<Scope = NamespaceResourceScope>,
        K::DynamicType: Default,
    {
        match &self.config.watch {
            Some(namespace) => Api::namespaced(self.client.clone(), namespace),
            None => Api::all(self.client.clone()),
        }
    }
}

/// A job as a watch shows it: one that cannot be read must not hide the others.
pub type Seen = DeserializeGuard<RenderJobObject>;

/// Why a step failed; it is tried again.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The API server did not do it.
    #[error("cannot {action}: {source}")]
    Api {
        /// What.
        action: &'static str,
        /// Why not.
        source: kube::Error,
    },
    /// The storage cannot be found out.
    #[error(transparent)]
    Storage(#[from] StorageError),
    /// The API server does not take the workers' pods as the job wants them.
    #[error("{0}")]
    Template(String),
    /// The API server takes no pod of the job just now.
    #[error("{0}")]
    Refused(String),
    /// The storage does not do it.
    #[error("cannot clean the storage: {0}")]
    Clean(String),
    /// A mistake of Rayherd.
    #[error("internal error: {0}; please report it")]
    Internal(String),
}

fn api(action: &'static str) -> impl Fn(kube::Error) -> Error {
    move |source| Error::Api { action, source }
}

/// Tries again, later for each failure in a row; jobs that fail together do not come back together.
pub fn failed(job: Arc<Seen>, error: &Error, context: Arc<Context>) -> Action {
    context.metrics.errors.inc();
    tracing::warn!(job = %job.name_any(), "{error}");
    let rest = context.failures.failed(job.meta().uid.as_deref().unwrap_or_default(), FAILED);
    let is_away = match error {
        Error::Api { source, .. } | Error::Storage(StorageError::Api { source, .. }) => {
            !matches!(source, kube::Error::Api(_))
        }
        _ => false,
    };
    // all wait for the same, and are to go on soon after it is back; never more than 10 s, and still not all at once
    Action::requeue(if is_away { rest.min(FAILED + rest / 20) } else { rest })
}

/// One step.
///
/// # Errors
/// When the API server or the storage does not do what is asked; the step is tried again.
pub async fn reconcile(job: Arc<Seen>, context: Arc<Context>) -> Result<Action, Error> {
    let (since, mut waited) = (Instant::now(), Duration::ZERO);
    let result = match &job.0 {
        Ok(job) => step(&Arc::new(job.clone()), &context, &mut waited).await,
        Err(invalid) => unreadable(invalid, &context).await,
    };
    context.metrics.reconcile_seconds.observe(since.elapsed().saturating_sub(waited).as_secs_f64());
    if result.is_ok() {
        context.failures.succeeded(job.meta().uid.as_deref().unwrap_or_default());
    }
    result
}

/// `waited` is told how long it waited for what is no fault of the operator nor of the API server, so that nobody is alarmed by it.
async fn step(job: &Arc<RenderJobObject>, context: &Arc<Context>, waited: &mut Duration) -> Result<Action, Error> {
    // somebody else's: nothing is made of it, and nothing said
    if job.spec.managed_by.as_deref().is_some_and(|m| m != MANAGED_BY) {
        return Ok(Action::await_change());
    }
    let namespace = job.namespace().unwrap_or_default();
    let uid = job.metadata.uid.clone().unwrap_or_default();
    let jobs: Api<Seen> = Api::namespaced(context.client.clone(), &namespace);
    if job.metadata.deletion_timestamp.is_some() {
        return delete(job, context, &jobs, &uid).await;
    }
    if status::is_finished(job) {
        // its workers wait for more samples, if this operator has them
        if let Some(left) = status::warm(job, Timestamp::now())
            && context.jobs.get(&uid).is_some()
        {
            return Ok(Action::requeue(left));
        }
        context.jobs.remove(&uid);
        remove_pods(job, context, &namespace, &uid).await?;
        return expire(job, &jobs).await;
    }
    let problems = validate(&job.job());
    if !problems.is_empty() {
        let told: Vec<String> = problems.iter().map(ToString::to_string).collect();
        let refused = status::refused(job, "Invalid", &told.join("; "), true, Timestamp::now());
        tell(job, context, &jobs, refused).await?;
        return Ok(Action::await_change());
    }
    if job.spec.suspend {
        if !stop(context, &uid, "the job is suspended") {
            return Ok(Action::requeue(SOON));
        }
        remove_pods(job, context, &namespace, &uid).await?;
        tell(job, context, &jobs, status::suspended(job, Timestamp::now())).await?;
        return Ok(Action::await_change());
    }
    if status::deadline(job).is_some_and(|d| Timestamp::now() >= d) {
        if !stop(context, &uid, "the job's deadline is over") {
            return Ok(Action::requeue(SOON));
        }
        remove_pods(job, context, &namespace, &uid).await?;
        tell(job, context, &jobs, status::late(job, Timestamp::now())).await?;
        return Ok(Action::await_change());
    }
    let running = match context.jobs.get(&uid) {
        Some(running) if running.generation == job.metadata.generation.unwrap_or(0) => running,
        Some(old) => {
            // the spec was changed: what was committed stays, and the new one goes on from there
            old.fleet.cancel("the job was changed");
            if !old.is_over() {
                return Ok(Action::requeue(SOON));
            }
            let keeps = build::same_workers(&old.spec, &job.spec);
            if !keeps {
                old.fleet.end();
            }
            match begin(job, context, &jobs, (&namespace, &uid), Some(old.as_ref()).filter(|_| keeps)).await? {
                Ok(running) => {
                    old.fleet.retire();
                    running
                }
                Err(later) => return Ok(later),
            }
        }
        None => match begin(job, context, &jobs, (&namespace, &uid), None).await? {
            Ok(running) => running,
            Err(later) => return Ok(later),
        },
    };
    let stopped = matches!(&running.lock().end, Some((_, Err(p))) if p.stopped);
    if stopped {
        // somebody else moved the ledger, or the API server or the stores were away too long: begin anew from what it says
        context.jobs.hand_over(&uid);
        return Ok(Action::requeue(AGAIN));
    }
    running.fleet.show(job.annotations().contains_key(PREVIEW));
    // asked before its end is told: one that comes in between is told next time
    let over = running.is_over();
    if !over {
        keep_pods(job, context, (&namespace, &uid), &running, waited).await?;
    }
    tell(job, context, &jobs, status::running(job, &running, Timestamp::now())).await?;
    context.metrics.observe(&namespace, &job.name_any(), &running);
    if over {
        if let Some(warm) = build::keep_warm(job)
            && matches!(&running.lock().end, Some((_, Ok(()))))
        {
            return Ok(Action::requeue(warm));
        }
        context.jobs.remove(&uid);
        remove_pods(job, context, &namespace, &uid).await?;
        return Ok(Action::await_change());
    }
    Ok(Action::requeue(LOOK))
}

/// Begins to run a job; else when to look at it again, of which it was told why it does not run.
async fn begin(
    job: &Arc<RenderJobObject>,
    context: &Arc<Context>,
    jobs: &Api<Seen>,
    (namespace, uid): (&str, &str),
    before: Option<&Running>,
) -> Result<Result<Arc<Running>, Action>, Error> {
    match start(job, context, namespace, uid, before).await {
        Err(Error::Storage(e @ StorageError::Missing(_))) => {
            let refused = status::refused(job, "StorageMissing", &e.to_string(), false, Timestamp::now());
            tell(job, context, jobs, refused).await?;
            Ok(Err(Action::requeue(AGAIN)))
        }
        Err(Error::Refused(message)) => {
            let refused = status::refused(job, status::PODS_REFUSED, &message, false, Timestamp::now());
            tell(job, context, jobs, refused).await?;
            Ok(Err(Action::requeue(AGAIN)))
        }
        Err(Error::Template(message)) => {
            // what is left of an earlier spec goes with it
            context.jobs.remove(uid);
            remove_pods(job, context, namespace, uid).await?;
            tell(job, context, jobs, status::refused(job, "BadTemplate", &message, true, Timestamp::now())).await?;
            Ok(Err(Action::await_change()))
        }
        other => other.map(Ok),
    }
}

/// Stops a job, if it runs here; whether it has stopped. What was committed stays.
fn stop(context: &Context, uid: &str, why: &str) -> bool {
    let Some(running) = context.jobs.get(uid) else { return true };
    running.fleet.cancel(why);
    running.fleet.end();
    let over = running.is_over();
    if over {
        context.jobs.remove(uid);
    }
    over
}

/// Deletes a job that came to its end, when its time is over.
async fn expire(job: &RenderJobObject, jobs: &Api<Seen>) -> Result<Action, Error> {
    match status::stays(job, Timestamp::now()) {
        None => return Ok(Action::await_change()),
        Some(left) if !left.is_zero() => return Ok(Action::requeue(left)),
        Some(_) => {}
    }
    // this job as it was seen, not one of the same name, and not one whose spec was changed meanwhile
    let (uid, resource_version) = (job.metadata.uid.clone(), job.metadata.resource_version.clone());
    let params = DeleteParams::default().preconditions(Preconditions { uid, resource_version });
    match jobs.delete(&job.name_any(), &params).await {
        Ok(_) => Ok(Action::await_change()),
        Err(kube::Error::Api(e)) if matches!(e.code, 404 | 409) => Ok(Action::await_change()),
        Err(e) => Err(api("delete the job whose time is over")(e)),
    }
}

/// A job that the API server took and we cannot read: a number that none of ours holds, or a field of another version.
async fn unreadable(invalid: &InvalidObject, context: &Arc<Context>) -> Result<Action, Error> {
    let mut job = RenderJobObject::new("", RenderJobSpec::default());
    job.metadata = invalid.metadata.clone();
    let (namespace, uid) = (job.namespace().unwrap_or_default(), job.metadata.uid.clone().unwrap_or_default());
    let jobs: Api<Seen> = Api::namespaced(context.client.clone(), &namespace);
    if job.metadata.deletion_timestamp.is_some() {
        // of its spec only the storage matters now
        let kind = ApiResource::erase::<RenderJobObject>(&());
        let raw: Api<DynamicObject> = Api::namespaced_with(context.client.clone(), &namespace, &kind);
        let raw = raw.get_opt(&job.name_any()).await.map_err(api("read the job"))?;
        let storage = raw.map(|r| r.data["spec"]["storage"].clone()).unwrap_or_default();
        job.spec.storage = serde_json::from_value(storage).unwrap_or_default();
        return delete(&job, context, &jobs, &uid).await;
    }
    if !stop(context, &uid, "the job was changed") {
        return Ok(Action::requeue(SOON));
    }
    remove_pods(&job, context, &namespace, &uid).await?;
    // a time that stays the same, so that telling it again changes nothing
    let since = job.metadata.creation_timestamp.as_ref().map_or(Timestamp::UNIX_EPOCH, |Time(t)| *t);
    let message = format!("the job cannot be read: {}", invalid.error);
    tell(&job, context, &jobs, status::refused(&job, "Unreadable", &message, true, since)).await?;
    Ok(Action::await_change())
}

/// Begins to run a job.
async fn start(
    job: &Arc<RenderJobObject>,
    context: &Arc<Context>,
    namespace: &str,
    uid: &str,
    before: Option<&Running>,
) -> Result<Arc<Running>, Error> {
    let jobs: Api<RenderJobObject> = Api::namespaced(context.client.clone(), namespace);
    let (storage, depot) = depot(context, job, namespace).await?;
    if job.spec.workers.template.is_some() {
        try_pod(job, context, namespace, &storage).await?;
    }
    let finalizers = job.metadata.finalizers.clone().unwrap_or_default();
    let job = if !finalizers.iter().any(|f| f == FINALIZER) {
        let all: Vec<String> = finalizers.into_iter().chain([FINALIZER.to_owned()]).collect();
        // the version keeps two writers of the list from losing each other's entries
        let patch = json!({"metadata": {"resourceVersion": job.metadata.resource_version, "finalizers": all}});
        let patched = jobs.patch(&job.name_any(), &PatchParams::default(), &Patch::Merge(&patch)).await;
        patched.map_err(api("note that the job has objects in the storage"))?
    } else {
        // as it is, not as a watch has it: the ledger's pointers may have moved since
        jobs.get(&job.name_any()).await.map_err(api("read the job"))?
    };
    let job = Arc::new(job);
    // an earlier operator may have left something there
    let (left, of_task) = (context.left.clone(), depot.clone());
    tokio::spawn(async move { left.find(&of_task).await });
    context.storages.add(&storage, &depot);
    let wake = Wake::of(&job, &context.steps);
    let running = run::start(context.client.clone(), job, storage, depot, context.turns.clone(), before, wake);
    context.jobs.insert(uid, running.clone());
    context.metrics.started.inc();
    Ok(running)
}

async fn depot(
    context: &Context,
    job: &RenderJobObject,
    namespace: &str,
) -> Result<(Storage, rayherd_herd::remote::Depot), Error> {
    let spec = &job.spec.storage;
    let found = storage::storage(&context.client, &context.config.namespace, spec).await?;
    let credentials = storage::credentials(&context.client, namespace, spec, &found).await?;
    let depot = found.depot(None, &credentials).map_err(|e| StorageError::Missing(e.to_string()))?;
    Ok((found, depot))
}

/// Makes and deletes pods so that each worker has one, and notes whose tokens count.
async fn keep_pods(
    job: &RenderJobObject,
    context: &Context,
    (namespace, uid): (&str, &str),
    running: &Running,
    waited: &mut Duration,
) -> Result<(), Error> {
    let pods: Api<Pod> = Api::namespaced(context.client.clone(), namespace);
    let found = list_pods(&pods, uid).await?;
    if running.is_local() && job.spec.placement != Placement::None {
        let from = Instant::now();
        sought(running).await;
        *waited = from.elapsed();
    }
    let killed = newly_killed(&mut running.lock(), kills(&found));
    for kill in killed {
        running.fleet.killed_for_memory(kill.number, kill.limit.as_deref());
    }
    // a session begins with its pod's name; one that is ending may still give back what it does
    let there: BTreeSet<(u32, String)> =
        found.iter().filter(|p| !is_over(p)).filter_map(|p| Some((build::number(p)?, p.name_any()))).collect();
    running.fleet.only(|number, session| {
        session.rsplit_once('-').is_none_or(|(pod, _)| there.contains(&(number, pod.to_owned())))
    });
    let (lies, placed, waits) = {
        let state = running.lock();
        // a known scene is looked up at once: workers of an earlier run must not go for that moment
        let fresh = state.started.is_some_and(|t| Timestamp::now().duration_since(t) < LOOK_UP);
        let lies = Lies { scene: state.held.clone(), source: state.source.clone().unwrap_or_default() };
        (lies, state.cut || state.scene.is_some(), state.known && fresh)
    };
    // until it is known where the scene's blocks are, or are to be, one worker prepares it
    let wanted = if placed { follow(job, running) } else { 1 };
    let mut plan = if waits && !placed {
        build::Plan::default()
    } else {
        build::plan(&job.name_any(), &found, wanted, (&lies.scene, job.spec.placement))
    };
    {
        let (mut state, now) = (running.lock(), Timestamp::now());
        for pod in found.iter().filter(|p| p.metadata.deletion_timestamp.is_none()) {
            let (Some(number), Some(status)) = (build::number(pod), &pod.status) else { continue };
            let long = || status.start_time.as_ref().is_some_and(|Time(t)| now.duration_since(*t) > WELL);
            match status.phase.as_deref() {
                Some("Failed") => state.rests.failed(number, uid, NO_POD, now),
                Some("Running") if long() => state.rests.well(number),
                _ => {}
            }
        }
        if plan.make.is_empty() {
            state.refused = None;
        }
        // pods that fail one after the other are not made without rest
        plan.make.retain(|(number, _)| state.rests.may(*number, now));
    }
    {
        let living = found.iter().filter(|p| p.metadata.deletion_timestamp.is_none());
        let by_uid = living.filter_map(|p| Some((p.metadata.uid.clone()?, build::number(p)?)));
        running.lock().pods = by_uid.collect();
    }
    for name in &plan.delete {
        delete_pod(&pods, name).await?;
    }
    let trusted = context.trusted.read().unwrap_or_else(PoisonError::into_inner).clone();
    let unfit = running.fleet.unfit();
    if let Some(&first) = unfit.first() {
        let made = build::pod(job, &context.config, &running.storage(), &lies, &trusted, first, "");
        let made = made.map_err(|e| Error::Internal(e.to_string()))?;
        for name in build::outdated(&found, &unfit, &made) {
            tracing::info!(pod = name, "a worker of another version cannot do the job: another takes its place");
            delete_pod(&pods, name).await?;
        }
    }
    let given = pods_as_given(context, namespace);
    if !plan.make.is_empty() {
        // those that are known serve as well
        if let Err(e) = find_servers(context, job, running).await {
            tracing::warn!(job = %job.name_any(), "{e}");
        }
    }
    let storage = running.storage();
    for (number, name) in &plan.make {
        let pod = build::pod(job, &context.config, &storage, &lies, &trusted, *number, name)
            .map_err(|e| Error::Internal(e.to_string()))?;
        let params = PatchParams::apply(MANAGER);
        match given.patch(name, &params, &Patch::Apply(&pod)).await {
            Ok(made) => {
                let mut state = running.lock();
                state.refused = None;
                state.pods.extend(made.metadata.uid.map(|uid| (uid, *number)));
            }
            // a quota that is used up, a namespace's rules: whoever may change them is told, and it is tried again
            Err(kube::Error::Api(e)) if matches!(e.code, 400 | 403 | 422) => {
                context.metrics.errors.inc();
                let mut state = running.lock();
                state.rests.failed(*number, uid, NO_POD, Timestamp::now());
                state.refused = Some(format!("the API server does not take the pod of worker {number}: {}", e.message));
            }
            Err(e) => return Err(api("make a worker's pod")(e)),
        }
    }
    Ok(())
}

/// Waits a moment until it is known where the job's scene lies, or its source: workers are not to come up elsewhere.
async fn sought(running: &Running) {
    let is_known = || {
        let state = running.lock();
        let late = state.started.is_none_or(|t| Timestamp::now().duration_since(t) >= SOUGHT);
        late || state.source.is_some() || !state.held.is_empty() || state.end.is_some()
    };
    while !is_known() {
        tokio::time::sleep(SEEKING).await;
    }
}

/// Looks again where servers are that were away when the job began: a worker beside one is to know it.
async fn find_servers(context: &Context, job: &RenderJobObject, running: &Running) -> Result<(), Error> {
    let known = running.storage();
    if !running.is_local() || known.endpoints.iter().all(|e| e.node.is_some()) {
        return Ok(());
    }
    let mut found = storage::storage(&context.client, &context.config.namespace, &job.spec.storage).await?;
    if found.endpoints.len() != known.endpoints.len() {
        // another profile: it is for jobs that begin from now on
        return Ok(());
    }
    for (now, before) in found.endpoints.iter_mut().zip(&known.endpoints) {
        if now.url != before.url {
            return Ok(());
        }
        now.node = now.node.take().or_else(|| before.node.clone());
    }
    *running.storage.write().unwrap_or_else(PoisonError::into_inner) = Storage { endpoints: found.endpoints, ..known };
    Ok(())
}

/// Those of some kills that were not seen before.
fn newly_killed(state: &mut State, kills: Vec<Kill>) -> Vec<Kill> {
    let seen: BTreeSet<String> = kills.iter().map(|k| k.id.clone()).collect();
    let Some(known) = state.killed.replace(seen) else { return Vec::new() };
    kills.into_iter().filter(|k| !known.contains(&k.id)).collect()
}

/// How many workers a job is to have now; noted, where that follows the work.
fn follow(job: &RenderJobObject, running: &Running) -> u32 {
    let mut state = running.lock();
    let wanted = build::wanted(job, state.to_do(), state.wanted);
    state.wanted = job.spec.workers.max.map(|_| wanted);
    wanted
}

/// Pods as JSON: what a job's template says of them goes to the API server as it is, which knows what is right.
fn pods_as_given(context: &Context, namespace: &str) -> Api<DynamicObject> {
    Api::namespaced_with(context.client.clone(), namespace, &ApiResource::erase::<Pod>(&()))
}

/// Has the API server look at a worker's pod without making it.
async fn try_pod(job: &RenderJobObject, context: &Context, namespace: &str, storage: &Storage) -> Result<(), Error> {
    // a name that none of ours has: nothing is made
    let name = format!("{}-template", job.name_any());
    let pod = build::pod(job, &context.config, storage, &Lies::default(), "", 0, &name);
    let pod = pod.map_err(|e| Error::Internal(e.to_string()))?;
    let params = PatchParams { field_validation: Some(ValidationDirective::Strict), ..PatchParams::apply(MANAGER) };
    match pods_as_given(context, namespace).patch(&name, &params.dry_run().force(), &Patch::Apply(&pod)).await {
        Ok(_) => Ok(()),
        // that passes when somebody else's pods end
        Err(kube::Error::Api(e)) if e.code == 403 && e.message.contains("exceeded quota") => {
            Err(Error::Refused(format!("there is no room for the workers' pods: {}", e.message)))
        }
        // a field that there is not is refused with 500
        Err(kube::Error::Api(e)) if matches!(e.code, 400 | 403 | 422) || e.message.contains("typed patch") => {
            Err(Error::Template(format!(
                "spec.workers.template does not make a pod that the API server takes: {}",
                e.message
            )))
        }
        Err(e) => Err(api("try a worker's pod")(e)),
    }
}

/// Whether nothing of a pod runs any more.
fn is_over(pod: &Pod) -> bool {
    let phase = pod.status.as_ref().and_then(|s| s.phase.as_deref());
    matches!(phase, Some("Succeeded" | "Failed"))
}

async fn list_pods(pods: &Api<Pod>, uid: &str) -> Result<Vec<Pod>, Error> {
    let params = ListParams::default().labels(&format!("{}={uid}", build::LABEL));
    Ok(pods.list(&params).await.map_err(api("list the workers' pods"))?.items)
}

async fn delete_pod(pods: &Api<Pod>, name: &str) -> Result<(), Error> {
    match pods.delete(name, &DeleteParams::default()).await {
        Ok(_) => Ok(()),
        Err(kube::Error::Api(e)) if e.code == 404 => Ok(()),
        Err(e) => Err(api("delete a worker's pod")(e)),
    }
}

/// Deletes a job's pods; whether none of them can write to the storage any more.
async fn remove_pods(job: &RenderJobObject, context: &Context, namespace: &str, uid: &str) -> Result<bool, Error> {
    let pods: Api<Pod> = Api::namespaced(context.client.clone(), namespace);
    context.metrics.forget(namespace, &job.name_any());
    let found = list_pods(&pods, uid).await?;
    for pod in found.iter().filter(|p| p.metadata.deletion_timestamp.is_none()) {
        delete_pod(&pods, &pod.name_any()).await?;
    }
    Ok(!found.iter().any(|p| may_write(p, Timestamp::now())))
}

fn may_write(pod: &Pod, now: Timestamp) -> bool {
    // the time that a deleted pod carries is the end of its grace period
    let silent = pod.metadata.deletion_timestamp.as_ref().is_some_and(|Time(t)| now.duration_since(*t) > SILENT);
    !is_over(pod) && !silent
}

/// Writes the status, if it says something new.
async fn tell(
    job: &RenderJobObject,
    context: &Context,
    jobs: &Api<Seen>,
    status: RenderJobStatus,
) -> Result<(), Error> {
    let known = job.status.clone().map(|s| RenderJobStatus { ledger: Vec::new(), ..s });
    if known.as_ref() == Some(&status) {
        return Ok(());
    }
    let patch = json!({
        "apiVersion": rayherd_api::API_VERSION,
        "kind": rayherd_api::KIND,
        "status": status,
    });
    let params = PatchParams::apply(MANAGER).force();
    match jobs.patch_status(&job.name_any(), &params, &Patch::Apply(&patch)).await {
        Ok(_) => {}
        Err(kube::Error::Api(e)) if e.code == 404 => return Ok(()),
        Err(e) => return Err(api("write the status")(e)),
    }
    for condition in status::news(known.as_ref(), &status) {
        let bad =
            condition.type_ == "Failed" || condition.status == "False" || condition.reason == status::PODS_REFUSED;
        let event = Event {
            type_: if bad { EventType::Warning } else { EventType::Normal },
            reason: if condition.type_ == "Prepared" { "Prepared".into() } else { condition.reason.clone() },
            note: Some(condition.message[..condition.message.floor_char_boundary(MOST_NOTE)].to_owned()),
            action: condition.type_.clone(),
            secondary: None,
        };
        // the status says it too
        if let Err(e) = context.events.publish(&event, &job.object_ref(&())).await {
            tracing::warn!("no event: {e}");
        }
    }
    Ok(())
}

/// The job is being deleted: its thread ends, its objects go, the finalizer last.
async fn delete(job: &RenderJobObject, context: &Context, jobs: &Api<Seen>, uid: &str) -> Result<Action, Error> {
    let finalizers = job.metadata.finalizers.clone().unwrap_or_default();
    let namespace = job.namespace().unwrap_or_default();
    if !finalizers.iter().any(|f| f == FINALIZER) {
        context.jobs.remove(uid);
        context.metrics.forget(&namespace, &job.name_any());
        return Ok(Action::await_change());
    }
    if !stop(context, uid, "the job is deleted") {
        return Ok(Action::requeue(SOON));
    }
    // what a worker is about to write would stay for ever
    if !remove_pods(job, context, &namespace, uid).await? {
        return Ok(Action::requeue(SOON));
    }
    match depot(context, job, &namespace).await {
        Ok((_, depot)) => match finish::clean(&depot, uid).await {
            Ok(true) => {}
            Ok(false) => context.left.add(uid, depot),
            // keys that may not read or delete have written nothing, as a rule; the job must not stay for that either
            Err(e @ StoreError::Denied { .. }) => {
                tracing::warn!(job = %job.name_any(), "objects of the deleted job may be left in its storage: {e}");
            }
            Err(e) => return Err(Error::Clean(e.to_string())),
        },
        // without its storage nothing can be deleted there, ever: the job must not stay for that
        Err(Error::Storage(e @ StorageError::Missing(_))) => {
            tracing::warn!(job = %job.name_any(), "objects of the deleted job may be left in its storage: {e}");
        }
        Err(e) => return Err(e),
    }
    let left: Vec<String> = finalizers.into_iter().filter(|f| f != FINALIZER).collect();
    let patch = json!({"metadata": {"resourceVersion": job.metadata.resource_version, "finalizers": left}});
    match jobs.patch(&job.name_any(), &PatchParams::default(), &Patch::Merge(&patch)).await {
        Ok(_) => Ok(Action::await_change()),
        Err(kube::Error::Api(e)) if e.code == 404 => Ok(Action::await_change()),
        Err(e) => Err(api("let the deleted job go")(e)),
    }
}
