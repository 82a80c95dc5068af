//! The status of a job. Pure: a function of what was known and what is known now.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::{Condition, Time};
use k8s_openapi::jiff::Timestamp;
use rayherd_api::resource::{RenderJobObject, RenderJobStatus};
use rayherd_herd::remote::fleet::Tally;
use rayherd_herd::report::{Kind, Op, Place};

use crate::jobs::{Running, State};

/// A job cannot be run as it stands.
pub fn refused(job: &RenderJobObject, reason: &str, message: &str, for_good: bool, now: Timestamp) -> RenderJobStatus {
    let mut status = known(job);
    status.phase = Some(if for_good { "Failed" } else { "Pending" }.into());
    set(job, &mut status, "Accepted", "False", reason, message, now);
    if for_good {
        set(job, &mut status, "Failed", "True", reason, message, now);
        status.completion_time.get_or_insert(Time(now));
    }
    status
}

/// A job runs here, or has run.
pub fn running(job: &RenderJobObject, running: &Running, now: Timestamp) -> RenderJobStatus {
    let (state, tally) = (running.lock().clone(), running.fleet.tally());
    let wanted = crate::build::slots(job).len();
    let local = running.storage.endpoints.iter().all(|e| e.node.is_some());
    of(job, &state, &tally, wanted, local, now)
}

fn of(
    job: &RenderJobObject,
    state: &State,
    tally: &Tally,
    wanted: usize,
    local: bool,
    now: Timestamp,
) -> RenderJobStatus {
    let mut status = known(job);
    let phase = match &state.end {
        Some((_, Ok(()))) => "Complete",
        Some((_, Err(problem))) if !problem.stopped => "Failed",
        _ if state.scene.is_some() => "Rendering",
        _ if tally.ready > 0 => "Preparing",
        _ => "Pending",
    };
    status.phase = Some(phase.into());
    let s = &state.status;
    if let Some(percent) = (s.samples * 100).checked_div(s.samples_total) {
        status.progress = Some(format!("{}%", percent.min(100)));
    }
    if phase == "Complete" {
        status.progress = Some("100%".into());
    }
    status.rel_mse =
        state.reports.last().and_then(|r| r.rel_mse).or(s.error).map(|e| format!("{e:.3e}")).or(status.rel_mse);
    status.rounds = Some(s.rounds as i64);
    status.rays_waiting = Some(s.waiting as i64);
    let scene = |k: Kind| matches!(k, Kind::Geometry | Kind::Attributes | Kind::Texture);
    let read = |place: Place| tally.bytes.sum(|_, o, k, p| o == Op::Read && p == place && scene(k));
    let (near, far) = (read(Place::Local), read(Place::Remote));
    if local && near + far > 0 {
        status.remote_read_ratio = Some(format!("{:.3}", far as f64 / (near + far) as f64));
    }
    status.cpu_seconds = Some(tally.cpu as i64);
    let ready = if matches!(phase, "Complete" | "Failed") { 0 } else { tally.ready };
    status.workers = Some(format!("{ready}/{wanted}"));
    status.scene = state.scene.clone().or(status.scene);
    status.locality = Some(if local { "per node" } else { "none" }.into());
    status.start_time = status.start_time.or(state.started.map(Time));
    status.first_task_time = status.first_task_time.or(state.first_task.map(Time));
    if !state.pictures.is_empty() {
        status.pictures.clone_from(&state.pictures);
    }
    set(job, &mut status, "Accepted", "True", "Valid", "the job can run", now);
    if state.scene.is_some() {
        let (reason, message) =
            if state.reused { ("Found", "the scene was prepared before") } else { ("Made", "the scene was prepared") };
        set(job, &mut status, "Prepared", "True", reason, message, now);
    }
    let is = |yes: bool| if yes { "True" } else { "False" };
    set(job, &mut status, "Running", is(matches!(phase, "Preparing" | "Rendering")), phase, "", now);
    match &state.end {
        Some((at, Ok(()))) => {
            set(job, &mut status, "Complete", "True", "Rendered", "all pictures are written", *at);
            status.conditions.retain(|c| c.type_ != "Failed");
            status.completion_time = Some(Time(*at));
        }
        Some((at, Err(problem))) if !problem.stopped => {
            set(job, &mut status, "Failed", "True", "CannotRender", &problem.message, *at);
            status.conditions.retain(|c| c.type_ != "Complete");
            status.completion_time = Some(Time(*at));
        }
        _ => {
            status.conditions.retain(|c| !matches!(c.type_.as_str(), "Complete" | "Failed"));
            status.completion_time = None;
        }
    }
    status
}

/// What was known, but for what another field manager owns.
fn known(job: &RenderJobObject) -> RenderJobStatus {
    let mut status = job.status.clone().unwrap_or_default();
    status.observed_generation = job.metadata.generation;
    status.ledger.clear();
    status
}

fn set(
    job: &RenderJobObject,
    status: &mut RenderJobStatus,
    kind: &str,
    value: &str,
    reason: &str,
    message: &str,
    now: Timestamp,
) {
    // what Kubernetes takes at most
    let message: String = message.chars().take(4000).collect();
    let found = status.conditions.iter_mut().find(|c| c.type_ == kind);
    let since = found.as_ref().filter(|c| c.status == value).map(|c| c.last_transition_time.clone());
    let condition = Condition {
        type_: kind.into(),
        status: value.into(),
        reason: reason.into(),
        message,
        observed_generation: job.metadata.generation,
        last_transition_time: since.unwrap_or(Time(now)),
    };
    match found {
        Some(found) => *found = condition,
        None => status.conditions.push(condition),
    }
}

/// Whether a job has come to its end, of the spec as it stands now.
pub fn is_finished(job: &RenderJobObject) -> bool {
    let Some(status) = &job.status else { return false };
    status.observed_generation == job.metadata.generation
        && matches!(status.phase.as_deref(), Some("Complete" | "Failed"))
}
