//! The status of a job. Pure: a function of what was known and what is known now.

use std::time::Duration;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::{Condition, MicroTime, Time};
use k8s_openapi::jiff::{SignedDuration, Timestamp};
use rayherd_api::resource::{MOST_MESSAGE, RenderJobObject, RenderJobStatus};
use rayherd_herd::job::spec::scene_settings;
use rayherd_herd::remote::fleet::Tally;
use rayherd_herd::report::{Kind, Op, Place};

use crate::jobs::{Running, State};

/// Reason of the condition `Running` while the API server takes no pods for some workers.
pub const PODS_REFUSED: &str = "PodsRefused";

/// A job cannot be run as it stands.
pub fn refused(job: &RenderJobObject, reason: &str, message: &str, for_good: bool, now: Timestamp) -> RenderJobStatus {
    let mut status = known(job);
    status.phase = Some("Pending".into());
    set(job, &mut status, "Accepted", "False", reason, message, now);
    if for_good { failed(job, status, reason, message, now) } else { status }
}

/// A job took too long.
pub fn late(job: &RenderJobObject, now: Timestamp) -> RenderJobStatus {
    let seconds = job.spec.active_deadline_seconds.unwrap_or_default();
    let message = format!(
        "not done {seconds} s after its start: raise spec.activeDeadlineSeconds, and it goes on from what was committed"
    );
    failed(job, known(job), "DeadlineExceeded", &message, now)
}

fn failed(
    job: &RenderJobObject,
    mut status: RenderJobStatus,
    reason: &str,
    message: &str,
    now: Timestamp,
) -> RenderJobStatus {
    status.phase = Some("Failed".into());
    status.workers = None;
    if status.conditions.iter().any(|c| c.type_ == "Running") {
        set(job, &mut status, "Running", "False", "Failed", "", now);
    }
    set(job, &mut status, "Failed", "True", reason, message, now);
    status.conditions.retain(|c| c.type_ != "Complete");
    status.completion_time.get_or_insert(Time(now));
    status
}

/// A job is not to be worked on for now. When it goes on, its time begins anew.
pub fn suspended(job: &RenderJobObject, now: Timestamp) -> RenderJobStatus {
    let mut status = known(job);
    status.phase = Some("Suspended".into());
    status.workers = None;
    (status.start_time, status.completion_time) = (None, None);
    set(job, &mut status, "Running", "False", "Suspended", "", now);
    set(job, &mut status, "Suspended", "True", "Suspended", "spec.suspend is true", now);
    status.conditions.retain(|c| !matches!(c.type_.as_str(), "Complete" | "Failed"));
    status
}

/// When a job that runs is given up, if ever.
pub fn deadline(job: &RenderJobObject) -> Option<Timestamp> {
    let seconds = job.spec.active_deadline_seconds?;
    let status = job.status.as_ref()?;
    // a job that was at its end, and has a new spec, has not begun yet
    if status.completion_time.is_some() {
        return None;
    }
    let Time(start) = status.start_time.as_ref()?;
    start.checked_add(SignedDuration::from_secs(seconds)).ok()
}

/// How much longer the workers of a job that came to its end are kept.
pub fn warm(job: &RenderJobObject, now: Timestamp) -> Option<Duration> {
    let status = job.status.as_ref()?;
    let complete = status.phase.as_deref() == Some("Complete");
    let seconds = job.spec.workers.keep_warm_seconds.filter(|_| complete)?;
    let Time(end) = status.completion_time.as_ref()?;
    let until = end.checked_add(SignedDuration::from_secs(seconds)).ok()?;
    let left = Duration::try_from(until.duration_since(now)).ok().filter(|d| !d.is_zero())?;
    // one that is deleted before takes them along
    Some(stays(job, now).map_or(left, |stays| stays.min(left))).filter(|d| !d.is_zero())
}

/// How long a job that came to its end stays; none for ever.
pub fn stays(job: &RenderJobObject, now: Timestamp) -> Option<Duration> {
    let seconds = job.spec.ttl_seconds_after_finished?;
    let Time(end) = job.status.as_ref()?.completion_time.as_ref()?;
    let until = end.checked_add(SignedDuration::from_secs(seconds)).ok()?;
    Some(Duration::try_from(until.duration_since(now)).unwrap_or_default())
}

/// What a person would want to know of a change: the conditions that were not as they are now.
pub fn news<'s>(known: Option<&RenderJobStatus>, status: &'s RenderJobStatus) -> Vec<&'s Condition> {
    let was = |c: &Condition| {
        let old = known.and_then(|k| k.conditions.iter().find(|o| o.type_ == c.type_));
        old.is_some_and(|o| (&o.status, &o.reason) == (&c.status, &c.reason))
    };
    let has_failed = status.phase.as_deref() == Some("Failed");
    let telling = |c: &&Condition| match (c.type_.as_str(), c.status.as_str()) {
        ("Prepared" | "Degraded" | "Suspended" | "Complete" | "Failed", "True") => true,
        ("Running", _) => c.reason == PODS_REFUSED,
        // what fails says so once
        ("Accepted", "False") => !has_failed,
        _ => false,
    };
    status.conditions.iter().filter(telling).filter(|c| !was(c)).collect()
}

/// A job runs here, or has run.
pub fn running(job: &RenderJobObject, running: &Running, now: Timestamp) -> RenderJobStatus {
    let (state, tally) = (running.lock().clone(), running.fleet.tally());
    let wanted = state.wanted.map_or_else(|| crate::build::slots(job).len(), |n| n as usize);
    of(job, &state, &tally, wanted, running.is_local(), now)
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
    let frames = job.spec.image.cameras.len().max(1);
    if s.samples_total > 0 {
        status.progress = Some(format!("{}%", (state.progress(frames) * 100.0) as u32));
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
    let (near, far) = (read(Place::Local) as i64, read(Place::Remote) as i64);
    let [all, far] = [state.before.read[0] + near + far, state.before.read[1] + far];
    if local && all > 0 {
        (status.scene_bytes_read, status.scene_bytes_remote) = (Some(all), Some(far));
        status.remote_read_ratio = Some(format!("{:.3}", far as f64 / all as f64));
    }
    status.cpu_seconds = Some(state.before.cpu + tally.cpu as i64);
    let ready = if matches!(phase, "Complete" | "Failed") { 0 } else { tally.ready };
    status.workers = Some(format!("{ready}/{wanted}"));
    if let Some(scene) = &state.scene {
        status.scene = Some(scene.clone());
        status.scene_settings = Some(scene_settings(&job.spec));
    }
    status.locality = Some(if local { "per node" } else { "none" }.into());
    // one that was at its end begins anew
    let goes_on = status.completion_time.is_none();
    status.start_time = status.start_time.filter(|_| goes_on).or(state.started.map(Time));
    status.first_task_time = status.first_task_time.filter(|_| goes_on).or(state.first_task.map(MicroTime));
    if !state.reports.is_empty() {
        let redone: u64 = state.reports.iter().map(|r| r.tasks_redone).sum();
        status.tasks_redone = Some(state.before.redone + redone as i64);
        status.frames_done = Some(state.reports.len() as i64);
    }
    if let Some(picture) = &state.picture {
        let folder = picture.rsplit_once('/').filter(|_| frames > 1).map(|(folder, _)| format!("{folder}/"));
        status.output = Some(folder.unwrap_or_else(|| picture.clone()));
    }
    set(job, &mut status, "Accepted", "True", "Valid", "the job can run", now);
    let has = |kind: &str| status.conditions.iter().any(|c| c.type_ == kind && c.status == "True");
    if state.scene.is_some() && !(state.known && has("Prepared")) {
        let (reason, message) =
            if state.reused { ("Found", "the scene was prepared before") } else { ("Made", "the scene was prepared") };
        set(job, &mut status, "Prepared", "True", reason, message, now);
    }
    match &state.below {
        Some(what) => set(job, &mut status, "Degraded", "True", "StoreSilent", what, now),
        None if status.conditions.iter().any(|c| c.type_ == "Degraded") => {
            set(job, &mut status, "Degraded", "False", "Copied", "there are enough copies again", now);
        }
        None => {}
    }
    if status.conditions.iter().any(|c| c.type_ == "Suspended") {
        set(job, &mut status, "Suspended", "False", "Resumed", "", now);
    }
    let is = |yes: bool| if yes { "True" } else { "False" };
    match &state.refused {
        Some(why) if state.end.is_none() => {
            set(job, &mut status, "Running", is(tally.ready > 0), PODS_REFUSED, why, now);
        }
        _ => set(job, &mut status, "Running", is(matches!(phase, "Preparing" | "Rendering")), phase, "", now),
    }
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
    // a longer one would be refused, and with it all of the status
    let message: String = message.chars().take(MOST_MESSAGE).collect();
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

#[cfg(test)]
mod tests {
    use rayherd_herd::report::{Report, Stage};
    use serde_json::json;

    use super::*;

    fn job(status: serde_json::Value) -> RenderJobObject {
        serde_json::from_value(json!({
            "apiVersion": "rayherd.io/v1alpha1",
            "kind": "RenderJob",
            "metadata": {"name": "box", "namespace": "studio", "uid": "u-1", "generation": 2},
            "spec": {"scene": {"source": "a/b.xml"}, "activeDeadlineSeconds": 60, "ttlSecondsAfterFinished": 30},
            "status": status,
        }))
        .unwrap()
    }

    fn at(second: i64) -> Timestamp {
        Timestamp::from_second(1_800_000_000 + second).unwrap()
    }

    #[test]
    fn time_counts_from_the_start_and_anew_after_a_suspension_or_an_end() {
        let begun = json!({"startTime": at(0).to_string()});
        assert_eq!(deadline(&job(begun.clone())), Some(at(60)));
        assert_eq!(deadline(&job(json!({}))), None);
        let mut without = job(begun.clone());
        without.spec.active_deadline_seconds = None;
        assert_eq!(deadline(&without), None);
        let slept = suspended(&job(begun.clone()), at(10));
        assert_eq!((slept.start_time.clone(), slept.phase.as_deref()), (None, Some("Suspended")));
        let given_up = late(&job(begun), at(61));
        assert_eq!(given_up.completion_time, Some(Time(at(61))));
        // a higher deadline: it begins anew
        let again = job(serde_json::to_value(&given_up).unwrap());
        assert_eq!(deadline(&again), None);
        let state = State { started: Some(at(100)), ..State::default() };
        let runs = of(&again, &state, &Tally::default(), 1, true, at(100));
        assert_eq!((runs.start_time.clone(), runs.completion_time), (Some(Time(at(100))), None));
        assert_eq!(deadline(&job(json!({"startTime": runs.start_time}))), Some(at(160)));
        // and what was suspended says that it is no longer
        let resumed = of(&job(serde_json::to_value(&slept).unwrap()), &state, &Tally::default(), 1, true, at(100));
        let condition = resumed.conditions.iter().find(|c| c.type_ == "Suspended").unwrap();
        assert_eq!((condition.status.as_str(), condition.reason.as_str()), ("False", "Resumed"));
    }

    #[test]
    fn a_job_at_its_end_stays_for_its_time() {
        let ended = job(json!({"completionTime": at(0).to_string()}));
        assert_eq!(stays(&ended, at(10)), Some(Duration::from_secs(20)));
        assert_eq!(stays(&ended, at(31)), Some(Duration::ZERO));
        let mut without = ended.clone();
        without.spec.ttl_seconds_after_finished = None;
        assert_eq!(stays(&without, at(31)), None);
    }

    #[test]
    fn far_reads_are_a_share_only_where_something_is_near() {
        use rayherd_herd::report::{Bytes, Stage};
        let mut bytes = Bytes::default();
        bytes.add(Stage::Trace, Op::Read, Kind::Geometry, Place::Remote, 100);
        let tally = Tally { bytes, ..Tally::default() };
        for (local, locality, ratio) in [(true, "per node", Some("1.000")), (false, "none", None)] {
            let status = of(&job(json!({})), &State::default(), &tally, 1, local, at(0));
            assert_eq!((status.locality.as_deref(), status.remote_read_ratio.as_deref()), (Some(locality), ratio));
        }
    }

    #[test]
    fn progress_is_of_all_frames_and_the_status_does_not_grow_with_them() {
        let mut three = job(json!({}));
        let camera = json!({"origin": [0, 0, 1], "target": [0, 0, 0], "fov": 40});
        three.spec.image.cameras = serde_json::from_value(json!([camera, camera, camera])).unwrap();
        let mut state = State { scene: Some("s".into()), ..State::default() };
        (state.status.samples, state.status.samples_total) = (50, 100);
        (state.status.rounds, state.status.waiting) = (3, 4000);
        let told = |state: &State| of(&three, state, &Tally::default(), 1, true, at(0));
        assert_eq!(told(&state).progress.as_deref(), Some("16%"));
        assert_eq!((told(&state).rounds, told(&state).rays_waiting), (Some(3), Some(4000)));
        state.status.rays.closest = 7;
        state.status.samples = 100;
        let report = Report { rays: state.status.rays, ..Report::default() };
        state.done(Some("http://s/b/output/n/j/j-1.exr".into()), report);
        assert_eq!(told(&state).progress.as_deref(), Some("33%"), "not counted twice");
        assert_eq!(state.rays().closest, 7);
        let size = |status: &RenderJobStatus| serde_json::to_string(status).unwrap().len();
        let one = size(&told(&state));
        (state.status.samples, state.status.samples_total) = (50, 100);
        assert_eq!(told(&state).progress.as_deref(), Some("50%"));
        state.done(Some("http://s/b/output/n/j/j-2.exr".into()), Report::default());
        let two = told(&state);
        assert_eq!((two.frames_done, two.output.as_deref()), (Some(2), Some("http://s/b/output/n/j/")));
        assert_eq!(size(&two), one);
        let single = job(json!({}));
        let status = of(&single, &state, &Tally::default(), 1, true, at(0));
        assert_eq!(status.output.as_deref(), Some("http://s/b/output/n/j/j-2.exr"));
    }

    #[test]
    fn what_was_counted_goes_on_over_failover_suspension_and_more_samples() {
        let new = job(json!({}));
        let mut tally = Tally { cpu: 10.5, ..Tally::default() };
        tally.bytes.add(Stage::Trace, Op::Read, Kind::Geometry, Place::Local, 75);
        tally.bytes.add(Stage::Trace, Op::Read, Kind::Geometry, Place::Remote, 25);
        let report = Report { tasks_redone: 2, ..Report::default() };
        let mut state = State { reports: vec![report], ..State::default() };
        let counted = |s: &RenderJobStatus| (s.cpu_seconds, s.tasks_redone, s.remote_read_ratio.clone());
        let first = of(&new, &state, &tally, 1, true, at(0));
        assert_eq!(counted(&first), (Some(10), Some(2), Some("0.250".into())));
        // another operator, or the next spec, which has done nothing yet, after a rest
        let slept = suspended(&job(serde_json::to_value(&first).unwrap()), at(1));
        assert_eq!(counted(&slept), counted(&first));
        let next = job(serde_json::to_value(&slept).unwrap());
        state = State { before: crate::jobs::Before::of(&next), ..State::default() };
        assert_eq!(counted(&of(&next, &state, &Tally::default(), 1, true, at(2))), counted(&first));
        let local = Tally { cpu: 1.0, ..Tally::default() };
        let third = of(&next, &state, &local, 1, true, at(2));
        assert_eq!(third.cpu_seconds, Some(11));
        tally.bytes.add(Stage::Trace, Op::Read, Kind::Geometry, Place::Local, 100);
        assert_eq!(of(&next, &state, &tally, 1, true, at(2)).remote_read_ratio.as_deref(), Some("0.167"));
        // told twice, counted once
        let again = of(&job(serde_json::to_value(&third).unwrap()), &state, &local, 1, true, at(2));
        assert_eq!(again, third);
    }

    /// One character more than the schema lets through, and the API server would take none of the status.
    #[test]
    fn a_message_is_cut_to_what_the_schema_takes() {
        let crd = serde_json::to_value(rayherd_api::resource::definition().unwrap()).unwrap();
        let schema = &crd["spec"]["versions"][0]["schema"]["openAPIV3Schema"]["properties"]["status"];
        let most = &schema["properties"]["conditions"]["items"]["properties"]["message"]["maxLength"];
        let told = refused(&job(json!({})), "Invalid", &"ö".repeat(100_000), true, at(0));
        let failed = told.conditions.iter().find(|c| c.type_ == "Failed").unwrap();
        assert_eq!(Some(failed.message.chars().count() as u64), most.as_u64());
    }

    #[test]
    fn each_change_is_told_once() {
        let told = |known: Option<&RenderJobStatus>, status: &RenderJobStatus| -> Vec<String> {
            news(known, status).iter().map(|c| c.type_.clone()).collect()
        };
        let new = job(json!({}));
        let waiting = refused(&new, "StorageMissing", "no", false, at(0));
        assert_eq!(told(None, &waiting), ["Accepted"]);
        assert_eq!(told(Some(&waiting), &waiting), [""; 0]);
        assert_eq!(told(Some(&waiting), &refused(&new, "Invalid", "no", true, at(0))), ["Failed"]);
        let mut state = State { scene: Some("s".into()), ..State::default() };
        let prepared = of(&new, &state, &Tally::default(), 1, true, at(0));
        assert_eq!(told(None, &prepared), ["Prepared"]);
        // no pods: that is told once, and when it is over there is nothing more to tell
        state.refused = Some("exceeded quota".into());
        let without = of(&new, &state, &Tally::default(), 1, true, at(0));
        assert_eq!(told(Some(&prepared), &without), ["Running"]);
        assert_eq!(told(Some(&without), &of(&new, &state, &Tally::default(), 1, true, at(1))), [""; 0]);
        let running = without.conditions.iter().find(|c| c.type_ == "Running").unwrap();
        assert_eq!((running.status.as_str(), running.message.as_str()), ("False", "exceeded quota"));
        state.refused = None;
        assert_eq!(told(Some(&without), &of(&new, &state, &Tally::default(), 1, true, at(1))), [""; 0]);
        state.end = Some((at(1), Ok(())));
        let complete = of(&new, &state, &Tally::default(), 1, true, at(1));
        assert_eq!(told(Some(&prepared), &complete), ["Complete"]);
        assert_eq!(told(Some(&complete), &suspended(&new, at(2))), ["Suspended"]);
    }
}
