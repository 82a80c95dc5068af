//! What the operator tells Prometheus.

use std::sync::Arc;
use std::time::Instant;

use axum::Router;
use axum::extract::State;
use axum::http::StatusCode;
use axum::routing::get;
use prometheus::{
    Encoder, GaugeVec, Histogram, HistogramOpts, IntCounter, IntCounterVec, IntGauge, Opts, Registry, TextEncoder,
};
use rayherd_herd::report::{Kind, Op, Place};

use crate::jobs::Running;
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
    /// Reports that nobody waits for (any more).
    pub ignored: IntCounter,
    refused: IntCounterVec,
    /// 1 for the operator that leads.
    pub leader: IntGauge,
    /// How long steps take.
    pub reconcile_seconds: Histogram,
    cpu: GaugeVec,
    remote: GaugeVec,
    bytes: GaugeVec,
    rounds: GaugeVec,
    tasks: GaugeVec,
    waiting: GaugeVec,
    workers: GaugeVec,
    wanted: GaugeVec,
    slots: GaugeVec,
    progress: GaugeVec,
    degraded: GaugeVec,
    error: GaugeVec,
    cache_failures: GaugeVec,
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
        let gauge = |name: &str, help: &str, labels: &[&str]| -> prometheus::Result<GaugeVec> {
            let gauge = GaugeVec::new(Opts::new(name, help), labels)?;
            registry.register(Box::new(gauge.clone()))?;
            Ok(gauge)
        };
        let buckets = vec![0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0];
        let options = HistogramOpts::new("rayherd_reconcile_duration_seconds", "duration of a reconcile step");
        let reconcile_seconds = Histogram::with_opts(options.buckets(buckets))?;
        registry.register(Box::new(reconcile_seconds.clone()))?;
        let name = "rayherd_worker_requests_refused_total";
        let refused =
            IntCounterVec::new(Opts::new(name, "requests to the task server that were refused"), &["reason"])?;
        registry.register(Box::new(refused.clone()))?;
        let leader = IntGauge::new("rayherd_leader", "1 for the operator that leads, 0 for one that waits")?;
        registry.register(Box::new(leader.clone()))?;
        for reason in Refused::ALL {
            refused.with_label_values(&[reason.name()]);
        }
        Ok(Metrics {
            errors: counter("rayherd_reconcile_errors_total", "reconcile steps that failed")?,
            watch_errors: counter("rayherd_watch_errors_total", "watches of the API server that failed")?,
            started: counter("rayherd_jobs_started_total", "jobs that were begun or gone on with")?,
            ignored: counter("rayherd_worker_reports_ignored_total", "reports of work that nobody waits for")?,
            refused,
            leader,
            cpu: gauge("rayherd_job_cpu_seconds", "CPU-seconds of the workers' tasks", &JOB)?,
            remote: gauge("rayherd_job_remote_read_ratio", "scene bytes read from other nodes, of all read", &JOB)?,
            bytes: gauge("rayherd_job_bytes", "bytes moved", &["namespace", "job", "stage", "op", "kind", "place"])?,
            rounds: gauge("rayherd_job_rounds", "rounds of the current frame", &JOB)?,
            tasks: gauge("rayherd_job_tasks", "tasks committed for the frames that are done", &JOB)?,
            waiting: gauge("rayherd_job_rays_waiting", "rays that wait in groups", &JOB)?,
            workers: gauge("rayherd_job_workers_ready", "workers that ask for work", &JOB)?,
            wanted: gauge("rayherd_job_workers_wanted", "workers that the job asks for", &JOB)?,
            slots: gauge("rayherd_job_slots", "tasks that all its workers do at a time", &JOB)?,
            progress: gauge("rayherd_job_progress_ratio", "camera samples made of those asked for", &JOB)?,
            degraded: gauge("rayherd_job_degraded", "1 while there are fewer copies than asked for", &JOB)?,
            error: gauge("rayherd_job_relmse", "estimated relMSE of the last frame that is done", &JOB)?,
            cache_failures: gauge(
                "rayherd_job_cache_failures",
                "copies that the workers' caches could not keep, or have lost",
                &JOB,
            )?,
            reconcile_seconds,
            registry,
        })
    }

    /// Counts a request that was refused.
    pub fn refuse(&self, reason: Refused) {
        self.refused.with_label_values(&[reason.name()]).inc();
    }

    /// Sets a job's metrics.
    pub fn observe(&self, namespace: &str, job: &str, running: &Running) {
        let (state, tally) = (running.lock().clone(), running.fleet.tally());
        let labels = [namespace, job];
        let scene = |k: Kind| matches!(k, Kind::Geometry | Kind::Attributes | Kind::Texture);
        let read = |place: Place| tally.bytes.sum(|_, o, k, p| o == Op::Read && p == place && scene(k));
        let (near, far) = (read(Place::Local), read(Place::Remote));
        // where no server is on a node all are far, and that is no fault
        if running.is_local() && near + far > 0 {
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
            let labels = [namespace, job, &stage, &op, &kind, &place];
            self.bytes.with_label_values(&labels).set(row.bytes as f64);
        }
        self.cpu.with_label_values(&labels).set(tally.cpu);
        self.cache_failures.with_label_values(&labels).set(tally.cache_failures as f64);
        self.rounds.with_label_values(&labels).set(state.status.rounds as f64);
        self.tasks.with_label_values(&labels).set(state.reports.iter().map(|r| r.tasks).sum::<u64>() as f64);
        self.waiting.with_label_values(&labels).set(state.status.waiting as f64);
        // workers that are kept warm have nothing to do, and should have
        let over = state.end.is_some();
        self.workers.with_label_values(&labels).set(if over { 0.0 } else { f64::from(tally.ready) });
        let slots = running.spec.workers.slots_per_node(1).filter(|_| !over).unwrap_or_default();
        self.wanted.with_label_values(&labels).set(slots.len() as f64);
        self.slots.with_label_values(&labels).set(slots.iter().map(|&s| f64::from(s)).sum());
        let (made, of) = (state.status.samples, state.status.samples_total.max(1));
        self.progress.with_label_values(&labels).set((made as f64 / of as f64).min(1.0));
        self.degraded.with_label_values(&labels).set(f64::from(u8::from(state.below.is_some())));
        if let Some(error) = state.reports.last().and_then(|r| r.rel_mse) {
            self.error.with_label_values(&labels).set(error);
        }
    }

    /// A job has ended: its labels go.
    pub fn forget(&self, namespace: &str, job: &str) {
        let gauges = [
            &self.cpu,
            &self.remote,
            &self.rounds,
            &self.tasks,
            &self.waiting,
            &self.workers,
            &self.wanted,
            &self.slots,
            &self.progress,
            &self.degraded,
            &self.error,
            &self.cache_failures,
        ];
        for gauge in gauges {
            // one that was never set has nothing to remove
            let _ = gauge.remove_label_values(&[namespace, job]);
        }
        self.forget_bytes(namespace, job);
    }

    fn forget_bytes(&self, namespace: &str, job: &str) {
        use prometheus::core::Collector;
        for family in self.bytes.collect() {
            for metric in family.get_metric() {
                let value = |n: &str| metric.get_label().iter().find(|l| l.name() == n).map(|l| l.value().to_owned());
                if value("namespace").as_deref() != Some(namespace) || value("job").as_deref() != Some(job) {
                    continue;
                }
                let all: Vec<String> =
                    ["namespace", "job", "stage", "op", "kind", "place"].iter().filter_map(|n| value(n)).collect();
                let all: Vec<&str> = all.iter().map(String::as_str).collect();
                let _ = self.bytes.remove_label_values(&all);
            }
        }
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

async fn health(State(context): State<Arc<Context>>) -> (StatusCode, &'static str) {
    if context.watching.is_dead(Instant::now()) {
        return (StatusCode::SERVICE_UNAVAILABLE, "the API server cannot be watched");
    }
    (StatusCode::OK, "ok")
}

/// Serves `/metrics`, and `/healthz` for the kubelet.
pub async fn serve(context: Arc<Context>) -> anyhow::Result<()> {
    let listener = tokio::net::TcpListener::bind(context.config.metrics).await?;
    let metrics = |State(context): State<Arc<Context>>| async move { context.metrics.text().unwrap_or_default() };
    let router = Router::new().route("/metrics", get(metrics)).route("/healthz", get(health));
    Ok(axum::serve(listener, router.with_state(context)).await?)
}

#[cfg(test)]
mod tests {
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
        for gauge in
            [&metrics.cpu, &metrics.remote, &metrics.rounds, &metrics.tasks, &metrics.waiting, &metrics.workers]
        {
            gauge.with_label_values(&["n", "j"]).set(1.0);
        }
        for gauge in [&metrics.wanted, &metrics.slots, &metrics.progress, &metrics.degraded, &metrics.error] {
            gauge.with_label_values(&["n", "j"]).set(1.0);
        }
        metrics.cache_failures.with_label_values(&["n", "j"]).set(1.0);
        metrics.bytes.with_label_values(&["n", "j", "trace", "read", "geometry", "local"]).set(1.0);
        let shown = metrics.text().unwrap();
        let exist: Vec<&str> = shown.lines().filter_map(|l| l.strip_prefix("# TYPE ")?.split(' ').next()).collect();
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../charts/rayherd/monitoring");
        let rules = std::fs::read_to_string(format!("{folder}/rules.yaml")).unwrap();
        let dashboard = std::fs::read_to_string(format!("{folder}/dashboard.json")).unwrap();
        let rules: serde_json::Value = serde_yaml::from_str(&rules).unwrap();
        let dashboard: serde_json::Value = serde_json::from_str(&dashboard).unwrap();
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
        assert!(count > 18, "{count}");
        // else Prometheus puts its own labels of these names in the place of ours, and no alert names its job
        let template = format!("{folder}/../templates/monitoring.yaml");
        assert!(std::fs::read_to_string(template).unwrap().contains("honorLabels: true"));
    }

    #[test]
    fn workers_of_a_job_that_is_over_are_wanted_no_more() {
        let metrics = Metrics::new().unwrap();
        let storage = rayherd_herd::remote::Storage { bucket: "b".into(), region: "r".into(), ..Default::default() };
        let running = Running {
            generation: 1,
            spec: rayherd_api::RenderJobSpec::default(),
            fleet: rayherd_herd::remote::Fleet::new(1, "e"),
            storage: storage.into(),
            state: Default::default(),
        };
        let wanted = || metrics.wanted.with_label_values(&["n", "a"]).get();
        metrics.observe("n", "a", &running);
        assert_eq!(wanted(), 1.0);
        running.lock().end = Some((k8s_openapi::jiff::Timestamp::UNIX_EPOCH, Ok(())));
        metrics.observe("n", "a", &running);
        assert_eq!((wanted(), metrics.slots.with_label_values(&["n", "a"]).get()), (0.0, 0.0));
    }

    #[test]
    fn names_are_unique_and_ended_jobs_leave_no_labels() {
        let metrics = Metrics::new().unwrap();
        for job in ["a", "b"] {
            for gauge in [
                &metrics.cpu,
                &metrics.remote,
                &metrics.rounds,
                &metrics.tasks,
                &metrics.waiting,
                &metrics.workers,
                &metrics.wanted,
                &metrics.slots,
                &metrics.progress,
                &metrics.degraded,
                &metrics.error,
            ] {
                gauge.with_label_values(&["n", job]).set(1.5);
            }
            metrics.bytes.with_label_values(&["n", job, "trace", "read", "geometry", "local"]).set(7.0);
        }
        // no family of jobs is left out
        let text = metrics.text().unwrap();
        let families = text.lines().filter(|l| l.starts_with("# TYPE rayherd_job_")).count();
        assert_eq!((text.matches("job=\"a\"").count(), families), (12, 12), "{text}");
        metrics.forget("n", "a");
        let text = metrics.text().unwrap();
        assert_eq!((text.matches("job=\"a\"").count(), text.matches("job=\"b\"").count()), (0, 12), "{text}");
        assert!(text.contains("rayherd_reconcile_errors_total 0"));
    }
}
