//! What the operator tells Prometheus.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use axum::Router;
use axum::extract::State as Given;
use axum::http::{Request, StatusCode};
use axum::routing::get;
use kube::client::Body;
use prometheus::core::{Atomic, Collector, GenericCounter, MetricVec, MetricVecBuilder};
use prometheus::{
    CounterVec, Encoder, GaugeVec, Histogram, HistogramOpts, IntCounter, IntCounterVec, IntGauge, Opts, Registry,
    TextEncoder,
};
use rayherd_api::RenderJobSpec;
use rayherd_herd::remote::fleet::{Outcome, Tally};
use rayherd_herd::report::{Kind, Op, Place};
use tower::util::MapRequestLayer;

use crate::jobs::{Running, State};
use crate::reconcile::Context;

/// All metrics.
pub struct Metrics {
    registry: Registry,
    /// Steps that failed.
    pub errors: IntCounter,
    /// Watches that failed.
    pub watch_errors: IntCounter,
    /// Jobs that were begun, or gone on with.
    pub started: IntCounter,
    /// Prepared scenes that were deleted since nobody used them.
    pub scenes_deleted: IntCounter,
    /// Reports that nobody waits for (any more).
    pub ignored: IntCounter,
    refused: IntCounterVec,
    asked: IntCounterVec,
    /// 1 for the operator that leads.
    pub leader: IntGauge,
    /// How long steps take, without what they wait for on purpose.
    pub reconcile_seconds: Histogram,
    of_jobs: OfJobs,
}

/// Families whose labels are those of jobs, and go with them.
struct OfJobs {
    cpu: CounterVec,
    bytes: IntCounterVec,
    rays: IntCounterVec,
    hops: IntCounterVec,
    tasks: IntCounterVec,
    worker_cpu: CounterVec,
    worker_slots: GaugeVec,
    resident: GaugeVec,
    remote: GaugeVec,
    rounds: GaugeVec,
    queued: GaugeVec,
    running: GaugeVec,
    waiting: GaugeVec,
    workers: GaugeVec,
    wanted: GaugeVec,
    slots: GaugeVec,
    progress: GaugeVec,
    degraded: GaugeVec,
    error: GaugeVec,
    cache_failures: IntCounterVec,
}

/// Why the task server refused a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refused {
    /// No handshake: no TLS, or a client that does not trust us.
    Tls,
    /// No token, or none that proves a pod.
    Token,
    /// The token of a pod that is not the job's worker who claims to speak.
    Pod,
}

impl Refused {
    const ALL: [Refused; 3] = [Refused::Tls, Refused::Token, Refused::Pod];

    fn name(self) -> &'static str {
        match self {
            Refused::Tls => "tls",
            Refused::Token => "token",
            Refused::Pod => "pod",
        }
    }
}

const JOB: [&str; 2] = ["namespace", "job"];
const WORKER: [&str; 3] = ["namespace", "job", "worker"];

impl Metrics {
    /// All at 0.
    ///
    /// # Errors
    /// When two have one name.
    pub fn new() -> prometheus::Result<Self> {
        let registry = Registry::new();
        let counter = |name: &str, help: &str| -> prometheus::Result<IntCounter> {
            let counter = IntCounter::new(name, help)?;
            registry.register(Box::new(counter.clone()))?;
            Ok(counter)
        };
        let buckets = vec![0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0];
        let options = HistogramOpts::new(
            "rayherd_reconcile_duration_seconds",
            "duration of a reconcile step, without what it waits for on purpose",
        );
        let reconcile_seconds = Histogram::with_opts(options.buckets(buckets))?;
        registry.register(Box::new(reconcile_seconds.clone()))?;
        let name = "rayherd_worker_requests_refused_total";
        let refused =
            IntCounterVec::new(Opts::new(name, "requests to the task server that were refused"), &["reason"])?;
        registry.register(Box::new(refused.clone()))?;
        let leader = IntGauge::new("rayherd_leader", "1 for the operator that leads, 0 for one that waits")?;
        registry.register(Box::new(leader.clone()))?;
        let name = "rayherd_api_requests_total";
        let asked = IntCounterVec::new(Opts::new(name, "requests to the API server"), &["verb"])?;
        registry.register(Box::new(asked.clone()))?;
        for reason in Refused::ALL {
            refused.with_label_values(&[reason.name()]);
        }
        Ok(Metrics {
            errors: counter("rayherd_reconcile_errors_total", "reconcile steps that failed")?,
            watch_errors: counter("rayherd_watch_errors_total", "watches of the API server that failed")?,
            started: counter("rayherd_jobs_started_total", "jobs that were begun or gone on with")?,
            scenes_deleted: counter(
                "rayherd_scenes_deleted_total",
                "prepared scenes that went since nobody used them",
            )?,
            ignored: counter("rayherd_worker_reports_ignored_total", "reports of work that nobody waits for")?,
            refused,
            asked,
            leader,
            of_jobs: OfJobs::new(&registry)?,
            reconcile_seconds,
            registry,
        })
    }

    /// Counts a request that was refused.
    pub fn refuse(&self, reason: Refused) {
        self.refused.with_label_values(&[reason.name()]).inc();
    }

    /// Counts requests to the API server, by verb, on their way.
    pub fn requests(&self) -> MapRequestLayer<impl Fn(Request<Body>) -> Request<Body> + Clone + use<>> {
        let asked = self.asked.clone();
        MapRequestLayer::new(move |request: Request<Body>| {
            asked.with_label_values(&[&request.method().as_str().to_ascii_lowercase()]).inc();
            request
        })
    }

    /// Sets a job's metrics.
    pub fn observe(&self, namespace: &str, job: &str, running: &Running) {
        let (state, tally) = (running.lock().clone(), running.fleet.tally());
        let local = running.is_local();
        self.of_jobs.observe([namespace, job], &running.spec, &state, &tally, local);
    }

    /// A job has ended: its labels go.
    pub fn forget(&self, namespace: &str, job: &str) {
        self.of_jobs.forget(namespace, job);
    }

    /// As text.
    ///
    /// # Errors
    /// When a metric cannot be written.
    pub fn text(&self) -> prometheus::Result<String> {
        let mut out = Vec::new();
        TextEncoder::new().encode(&self.registry.gather(), &mut out)?;
        Ok(String::from_utf8_lossy(&out).into_owned())
    }
}

async fn health(Given(context): Given<Arc<Context>>) -> (StatusCode, &'static str) {
    if context.watching.is_dead(Instant::now()) {
        return (StatusCode::SERVICE_UNAVAILABLE, "the API server cannot be watched");
    }
    (StatusCode::OK, "ok")
}

impl OfJobs {
    fn new(registry: &Registry) -> prometheus::Result<Self> {
        let gauge = |name: &str, help: &str, labels: &[&str]| -> prometheus::Result<GaugeVec> {
            let gauge = GaugeVec::new(Opts::new(name, help), labels)?;
            registry.register(Box::new(gauge.clone()))?;
            Ok(gauge)
        };
        let counter = |name: &str, help: &str, labels: &[&str]| -> prometheus::Result<IntCounterVec> {
            let counter = IntCounterVec::new(Opts::new(name, help), labels)?;
            registry.register(Box::new(counter.clone()))?;
            Ok(counter)
        };
        let seconds = |name: &str, help: &str, labels: &[&str]| -> prometheus::Result<CounterVec> {
            let counter = CounterVec::new(Opts::new(name, help), labels)?;
            registry.register(Box::new(counter.clone()))?;
            Ok(counter)
        };
        let bytes = ["namespace", "job", "stage", "op", "kind", "place"];
        Ok(OfJobs {
            cpu: seconds("rayherd_job_cpu_seconds_total", "CPU-seconds of the workers' tasks", &JOB)?,
            bytes: counter("rayherd_job_bytes_total", "bytes moved", &bytes)?,
            rays: counter("rayherd_job_rays_total", "rays of committed tasks", &["namespace", "job", "kind"])?,
            hops: counter("rayherd_job_hops_total", "rays that left a task for a split that it did not hold", &JOB)?,
            tasks: counter(
                "rayherd_job_tasks_total",
                "attempts at tasks that ended",
                &["namespace", "job", "outcome"],
            )?,
            worker_cpu: seconds("rayherd_worker_cpu_seconds_total", "CPU-seconds of a worker's tasks", &WORKER)?,
            worker_slots: gauge("rayherd_worker_slots", "tasks that a worker does at a time", &WORKER)?,
            resident: gauge("rayherd_worker_resident_bytes", "scene data that a worker holds in memory", &WORKER)?,
            remote: gauge("rayherd_job_remote_read_ratio", "scene bytes read from other nodes, of all read", &JOB)?,
            rounds: gauge("rayherd_job_rounds", "rounds of the current frame", &JOB)?,
            queued: gauge("rayherd_job_queue_depth", "tasks and other work that no worker has taken yet", &JOB)?,
            running: gauge("rayherd_job_tasks_running", "tasks and other work in workers' hands", &JOB)?,
            waiting: gauge("rayherd_job_rays_waiting", "rays that wait in groups", &JOB)?,
            workers: gauge("rayherd_job_workers_ready", "workers that ask for work", &JOB)?,
            wanted: gauge("rayherd_job_workers_wanted", "workers that the job asks for", &JOB)?,
            slots: gauge("rayherd_job_slots", "tasks that all its workers do at a time", &JOB)?,
            progress: gauge("rayherd_job_progress_ratio", "camera samples made of those asked for", &JOB)?,
            degraded: gauge("rayherd_job_degraded", "1 while there are fewer copies than asked for", &JOB)?,
            error: gauge("rayherd_job_relmse", "estimated relMSE of the last frame that is done", &JOB)?,
            cache_failures: counter(
                "rayherd_job_cache_failures_total",
                "copies that the workers' caches could not keep, or have lost",
                &JOB,
            )?,
        })
    }

    fn observe(&self, labels: [&str; 2], spec: &RenderJobSpec, state: &State, tally: &Tally, local: bool) {
        let [namespace, job] = labels;
        let scene = |k: Kind| matches!(k, Kind::Geometry | Kind::Attributes | Kind::Texture);
        let read = |place: Place| tally.bytes.sum(|_, o, k, p| o == Op::Read && p == place && scene(k));
        let (near, far) = (read(Place::Local), read(Place::Remote));
        // where no store is on a node of ours there is no near
        if local && near + far > 0 {
            self.remote.with_label_values(&labels).set(far as f64 / (near + far) as f64);
        }
        for row in tally.bytes.rows() {
            // the names that reports use
            let name = |v: serde_json::Result<serde_json::Value>| match v {
                Ok(serde_json::Value::String(s)) => s,
                _ => String::new(),
            };
            let (stage, op) = (name(serde_json::to_value(row.stage)), name(serde_json::to_value(row.op)));
            let (kind, place) = (name(serde_json::to_value(row.kind)), name(serde_json::to_value(row.place)));
            raise(&self.bytes.with_label_values(&[namespace, job, &stage, &op, &kind, &place]), row.bytes);
        }
        raise(&self.cpu.with_label_values(&labels), tally.cpu);
        let rays = state.rays();
        let kinds =
            [("camera", rays.camera), ("closest", rays.closest), ("shadow", rays.shadow), ("merged", rays.merged)];
        for (kind, count) in kinds {
            raise(&self.rays.with_label_values(&[namespace, job, kind]), count);
        }
        raise(&self.hops.with_label_values(&labels), tally.hops);
        raise(&self.cache_failures.with_label_values(&labels), tally.cache_failures);
        for outcome in Outcome::ALL {
            let count = tally.outcomes.get(&outcome).copied().unwrap_or(0);
            raise(&self.tasks.with_label_values(&[namespace, job, outcome.name()]), count);
        }
        let slots = spec.workers.slots_per_node(1).unwrap_or_default();
        for (number, of_worker) in &tally.by_worker {
            let labels = [namespace, job, &number.to_string()];
            raise(&self.worker_cpu.with_label_values(&labels), of_worker.cpu);
            let slots = slots.get(*number as usize).copied().unwrap_or(1);
            self.worker_slots.with_label_values(&labels).set(f64::from(slots));
            self.resident.with_label_values(&labels).set(of_worker.resident as f64);
        }
        self.rounds.with_label_values(&labels).set(state.status.rounds as f64);
        self.queued.with_label_values(&labels).set(tally.queued as f64);
        self.running.with_label_values(&labels).set(tally.running as f64);
        self.waiting.with_label_values(&labels).set(state.status.waiting as f64);
        // one that has ended asks for none: those that are kept warm are no job's that is stuck
        let ended = state.end.is_some();
        let wanted = if ended { 0 } else { state.wanted.map_or(slots.len(), |n| n as usize) };
        self.workers.with_label_values(&labels).set(if ended { 0.0 } else { f64::from(tally.ready) });
        self.wanted.with_label_values(&labels).set(wanted as f64);
        self.slots.with_label_values(&labels).set(slots.iter().take(wanted).map(|&s| f64::from(s)).sum());
        let frames = spec.image.cameras.len().max(1);
        let is_done = matches!(&state.end, Some((_, Ok(()))));
        self.progress.with_label_values(&labels).set(if is_done { 1.0 } else { state.progress(frames) });
        self.degraded.with_label_values(&labels).set(f64::from(u8::from(state.below.is_some())));
        if let Some(error) = state.reports.last().and_then(|r| r.rel_mse) {
            self.error.with_label_values(&labels).set(error);
        }
    }

    fn forget(&self, namespace: &str, job: &str) {
        let of = [namespace, job];
        for family in [&self.cpu, &self.worker_cpu] {
            drop_labels(family, of);
        }
        for family in [&self.bytes, &self.rays, &self.hops, &self.tasks, &self.cache_failures] {
            drop_labels(family, of);
        }
        let gauges = [
            &self.worker_slots,
            &self.resident,
            &self.remote,
            &self.rounds,
            &self.queued,
            &self.running,
            &self.waiting,
            &self.workers,
            &self.wanted,
            &self.slots,
            &self.progress,
            &self.degraded,
            &self.error,
        ];
        for family in gauges {
            drop_labels(family, of);
        }
    }
}

/// Raises a counter to what was counted. Where that is less, it was begun anew, and so is the counter.
fn raise<P: Atomic>(counter: &GenericCounter<P>, to: P::T)
where
    P::T: PartialOrd + std::ops::Sub<Output = P::T> + Copy,
{
    if counter.get() > to {
        counter.reset();
    }
    counter.inc_by(to - counter.get());
}

/// Removes all of a family that has these labels `namespace` and `job`.
fn drop_labels<T: MetricVecBuilder>(family: &MetricVec<T>, [namespace, job]: [&str; 2]) {
    for shown in family.collect() {
        for metric in shown.get_metric() {
            let labels: HashMap<&str, &str> = metric.get_label().iter().map(|l| (l.name(), l.value())).collect();
            if labels.get("namespace") == Some(&namespace) && labels.get("job") == Some(&job) {
                // it is there: it was just shown
                let _ = family.remove(&labels);
            }
        }
    }
}

/// Serves `/metrics`, and `/healthz` for the kubelet.
pub async fn serve(context: Arc<Context>) -> anyhow::Result<()> {
    let listener = tokio::net::TcpListener::bind(context.config.metrics).await?;
    let metrics = |Given(context): Given<Arc<Context>>| async move { context.metrics.text().unwrap_or_default() };
    let router = Router::new().route("/metrics", get(metrics)).route("/healthz", get(health));
    Ok(axum::serve(listener, router.with_state(context)).await?)
}

#[cfg(test)]
mod tests {
    use rayherd_herd::remote::fleet::WorkerTally;
    use rayherd_herd::report::{Report, Stage};

    use super::*;

    /// Words of a text that look like a metric's name, without the ends that a histogram adds.
    fn named(text: &str) -> Vec<String> {
        let words = text.split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'));
        let ours = words.filter(|w| w.starts_with("rayherd_")).map(|w| w.trim_end_matches("_bucket").to_owned());
        ours.collect()
    }

    #[test]
    fn alerts_and_dashboard_name_metrics_that_exist() {
        let metrics = Metrics::new().unwrap();
        // a family without a value is not shown
        observed(&metrics, "j", 1);
        metrics.asked.with_label_values(&["get"]).inc();
        let shown = metrics.text().unwrap();
        let exist: Vec<&str> = shown.lines().filter_map(|l| l.strip_prefix("# TYPE ")?.split(' ').next()).collect();
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../charts/rayherd/monitoring");
        let rules = std::fs::read_to_string(format!("{folder}/rules.yaml")).unwrap();
        let dashboard = std::fs::read_to_string(format!("{folder}/dashboard.json")).unwrap();
        let rules: serde_json::Value = serde_yaml::from_str(&rules).unwrap();
        let dashboard: serde_json::Value = serde_json::from_str(&dashboard).unwrap();
        let types: Vec<(&str, &str)> =
            shown.lines().filter_map(|l| l.strip_prefix("# TYPE ")?.split_once(' ')).collect();
        for (name, kind) in types {
            assert_eq!(name.ends_with("_total"), kind == "counter", "{name} is a {kind}");
        }
        let alerts = rules["groups"][0]["rules"].as_array().unwrap();
        let panels = dashboard["panels"].as_array().unwrap();
        assert!((6..=10).contains(&alerts.len()) && panels.len() > 8);
        let alerts = alerts.iter().map(|a| {
            assert!(a["annotations"]["action"].is_string(), "{} does not say what to do", a["alert"]);
            a["expr"].as_str().unwrap()
        });
        let mut count = 0;
        for expression in alerts.chain(panels.iter().map(|p| p["targets"][0]["expr"].as_str().unwrap())) {
            for name in named(expression) {
                assert!(exist.contains(&name.as_str()), "{expression}: there is no metric {name}");
                count += 1;
            }
        }
        assert!(count > 26, "{count}");
        // else Prometheus puts its own labels of these names in the place of ours, and no alert names its job
        let template = format!("{folder}/../templates/monitoring.yaml");
        assert!(std::fs::read_to_string(template).unwrap().contains("honorLabels: true"));
    }

    /// Tells all there is to tell of a job; how much was counted of it is a multiple of `n`.
    fn observed(metrics: &Metrics, job: &str, n: u64) {
        let mut tally = Tally { ready: 1, cpu: n as f64, hops: 3 * n, queued: 2, running: 1, ..Tally::default() };
        tally.bytes.add(Stage::Trace, Op::Read, Kind::Geometry, Place::Local, 7 * n);
        tally.outcomes.insert(Outcome::Made, 4 * n);
        tally.by_worker.insert(1, WorkerTally { cpu: n as f64, resident: 100 });
        let mut state = State { wanted: Some(2), ..State::default() };
        state.status.rays.shadow = n;
        state.reports.push(Report { rel_mse: Some(0.1), ..Report::default() });
        let mut spec = RenderJobSpec::default();
        spec.workers.slots = vec![2, 3];
        metrics.of_jobs.observe(["n", job], &spec, &state, &tally, true);
    }

    #[test]
    fn ended_jobs_leave_no_labels() {
        let metrics = Metrics::new().unwrap();
        for job in ["a", "b"] {
            observed(&metrics, job, 1);
        }
        let count = |job: &str| metrics.text().unwrap().matches(&format!("job=\"{job}\"")).count();
        // each family at least once
        let families = metrics.registry.gather();
        let of_jobs = |f: &&prometheus::proto::MetricFamily| {
            f.name().starts_with("rayherd_job_") || f.name().starts_with("rayherd_worker_")
        };
        let of_jobs = families
            .iter()
            .filter(of_jobs)
            .filter(|f| f.get_metric().iter().any(|m| m.get_label().iter().any(|l| l.name() == "job")));
        assert_eq!(of_jobs.count(), 20, "one that is not told of here may stay");
        assert!(count("a") >= 20 && count("a") == count("b"));
        let before = count("b");
        metrics.forget("n", "a");
        assert_eq!((count("a"), count("b")), (0, before), "{}", metrics.text().unwrap());
        assert!(metrics.text().unwrap().contains("rayherd_reconcile_errors_total 0"));
    }

    #[test]
    fn counters_only_rise_and_begin_anew_with_a_job_that_does() {
        let metrics = Metrics::new().unwrap();
        for (n, hops) in [(1, 3), (2, 6), (2, 6), (1, 3)] {
            observed(&metrics, "j", n);
            let text = metrics.text().unwrap();
            let hops = format!("rayherd_job_hops_total{{job=\"j\",namespace=\"n\"}} {hops}\n");
            assert!(text.contains(&hops), "{text}");
        }
        let text = metrics.text().unwrap();
        for line in [
            "rayherd_job_rays_total{job=\"j\",kind=\"shadow\",namespace=\"n\"} 1\n",
            "rayherd_job_tasks_total{job=\"j\",namespace=\"n\",outcome=\"made\"} 4\n",
            "rayherd_worker_cpu_seconds_total{job=\"j\",namespace=\"n\",worker=\"1\"} 1\n",
            "rayherd_worker_slots{job=\"j\",namespace=\"n\",worker=\"1\"} 3\n",
            "rayherd_worker_resident_bytes{job=\"j\",namespace=\"n\",worker=\"1\"} 100\n",
            "rayherd_job_queue_depth{job=\"j\",namespace=\"n\"} 2\n",
            "rayherd_job_workers_wanted{job=\"j\",namespace=\"n\"} 2\n",
        ] {
            assert!(text.contains(line), "{line}: {text}");
        }
    }
}
