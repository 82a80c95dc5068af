//! The task server: what workers ask, answered from the fleet of their job. Only the job's own pods are heard.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::extract::{DefaultBodyLimit, Path, State};
use axum::http::{HeaderMap, StatusCode};
use axum::routing::post;
use axum::{Json, Router};
use k8s_openapi::api::authentication::v1::{TokenReview, TokenReviewSpec};
use k8s_openapi::jiff::Timestamp;
use kube::Api;
use kube::api::PostParams;
use rayherd_herd::remote::fleet::Unknown;
use rayherd_herd::remote::{Answer, Beat, Poll, Report, WorkerId};

use crate::authority::{self, Serving};
use crate::build::AUDIENCE;
use crate::config::Config;
use crate::jobs::Running;
use crate::metrics::Refused;
use crate::reconcile::Context;
use crate::tls::{Current, Tls};

/// Between two looks whether the certificate is to be renewed.
const HOUR: Duration = Duration::from_secs(3600);
/// How long a question stays open: below what proxies cut.
const PATIENCE: Duration = Duration::from_secs(12);
/// How long a reviewed token is believed: a pod that is deleted is heard no longer than this.
const BELIEF: Duration = Duration::from_secs(30);
/// Most bytes of a report: it names what a task made.
const MOST: usize = 64 << 20;

/// Whose token it is.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Proof {
    pod_uid: String,
}

struct Server {
    context: Arc<Context>,
    believed: Mutex<BTreeMap<String, (Instant, Proof)>>,
}

type Refusal = (StatusCode, String);

/// Begins to listen, with a certificate of the operator's authority. Workers that are started from now on trust it.
pub async fn open(context: &Arc<Context>) -> anyhow::Result<Tls> {
    let serving = certificate(context).await?;
    let current = Current::new(serving.key);
    let of_counter = context.clone();
    let refused = move || of_counter.metrics.refuse(Refused::Tls);
    let tls = Tls::listen(context.config.listen, current.clone(), refused).await?;
    tokio::spawn(renew(context.clone(), current, serving.renew, HOUR));
    Ok(tls)
}

/// Loads or renews the authority; a certificate of it.
async fn certificate(context: &Context) -> anyhow::Result<Serving> {
    let Config { namespace, authority, .. } = &context.config;
    let now = Timestamp::now().as_second();
    let roots = authority::load(&context.client, namespace, authority, now).await?;
    *context.trusted.write().unwrap_or_else(PoisonError::into_inner) = roots.bundle();
    Ok(roots.serving(context.config.host()?, now)?)
}

/// Has another certificate each half of its life, for as long as the process lives; looks each `rest` whether it is time.
async fn renew(context: Arc<Context>, current: Arc<Current>, mut due: i64, rest: Duration) {
    loop {
        tokio::time::sleep(rest).await;
        if Timestamp::now().as_second() < due {
            continue;
        }
        match certificate(&context).await {
            Ok(serving) => {
                current.set(serving.key);
                due = serving.renew;
            }
            Err(e) => {
                context.metrics.errors.inc();
                tracing::error!("the certificate is not renewed, which is tried again in {} s: {e:#}", rest.as_secs());
            }
        }
    }
}

/// Serves until the process ends.
pub async fn serve(context: Arc<Context>, tls: Tls) -> anyhow::Result<()> {
    Ok(axum::serve(tls, router(context)).await?)
}

fn router(context: Arc<Context>) -> Router {
    let server = Arc::new(Server { context, believed: Mutex::default() });
    Router::new()
        .route("/v1/jobs/{uid}/poll", post(poll))
        .route("/v1/jobs/{uid}/report", post(report))
        .route("/v1/jobs/{uid}/beat", post(beat))
        .layer(DefaultBodyLimit::max(MOST))
        .with_state(server)
}

async fn poll(
    State(server): State<Arc<Server>>,
    Path(uid): Path<String>,
    headers: HeaderMap,
    Json(poll): Json<Poll>,
) -> Result<Json<Answer>, Refusal> {
    let running = server.hear(&uid, &headers, &poll.worker).await?;
    running.fleet.poll(&poll, PATIENCE).await.map(Json).map_err(unknown)
}

async fn report(
    State(server): State<Arc<Server>>,
    Path(uid): Path<String>,
    headers: HeaderMap,
    Json(report): Json<Report>,
) -> Result<Json<bool>, Refusal> {
    let running = server.hear(&uid, &headers, &report.worker).await?;
    let taken = running.fleet.report(report).map_err(unknown)?;
    if !taken {
        server.context.metrics.ignored.inc();
    }
    Ok(Json(taken))
}

async fn beat(
    State(server): State<Arc<Server>>,
    Path(uid): Path<String>,
    headers: HeaderMap,
    Json(beat): Json<Beat>,
) -> Result<Json<Vec<String>>, Refusal> {
    let running = server.hear(&uid, &headers, &beat.worker).await?;
    running.fleet.beat(&beat).map(Json).map_err(unknown)
}

fn unknown(e: Unknown) -> Refusal {
    (StatusCode::NOT_FOUND, e.to_string())
}

impl Server {
    /// The job, if it is a pod of this job and of this worker who speaks.
    async fn hear(&self, uid: &str, headers: &HeaderMap, worker: &WorkerId) -> Result<Arc<Running>, Refusal> {
        let refuse = |status: StatusCode, reason: Refused, why: &str| {
            self.context.metrics.refuse(reason);
            (status, why.to_owned())
        };
        let header = headers.get("authorization").and_then(|h| h.to_str().ok());
        let Some(token) = header.and_then(|h| h.strip_prefix("Bearer ")) else {
            return Err(refuse(StatusCode::UNAUTHORIZED, Refused::Token, "no token"));
        };
        // before the job is looked for: who proves nothing learns nothing
        let proof = self.review(token).await?;
        let Some(running) = self.context.jobs.get(uid) else {
            // it may be taken up in a moment, after this operator began
            return Err((StatusCode::SERVICE_UNAVAILABLE, "the job does not run here (yet)".into()));
        };
        let number = running.lock().pods.get(&proof.pod_uid).copied();
        match number {
            Some(number) if number == worker.number => Ok(running),
            Some(_) => Err(refuse(StatusCode::FORBIDDEN, Refused::Pod, "the token is another worker's")),
            None => Err(refuse(StatusCode::FORBIDDEN, Refused::Pod, "the token is of no pod of this job")),
        }
    }

    async fn review(&self, token: &str) -> Result<Proof, Refusal> {
        let known = {
            let mut believed = self.believed.lock().unwrap_or_else(PoisonError::into_inner);
            believed.retain(|_, (since, _)| since.elapsed() < BELIEF);
            believed.get(token).map(|(_, proof)| proof.clone())
        };
        if let Some(proof) = known {
            return Ok(proof);
        }
        let spec = TokenReviewSpec { audiences: Some(vec![AUDIENCE.into()]), token: Some(token.to_owned()) };
        let review = TokenReview { spec, ..TokenReview::default() };
        let reviews: Api<TokenReview> = Api::all(self.context.client.clone());
        let answer = reviews.create(&PostParams::default(), &review).await;
        let answer = answer.map_err(|e| (StatusCode::SERVICE_UNAVAILABLE, format!("cannot review the token: {e}")))?;
        let proof = proof(&answer).ok_or_else(|| {
            self.context.metrics.refuse(Refused::Token);
            (StatusCode::UNAUTHORIZED, "the token proves no pod".to_owned())
        })?;
        let entry = (Instant::now(), proof.clone());
        self.believed.lock().unwrap_or_else(PoisonError::into_inner).insert(token.to_owned(), entry);
        Ok(proof)
    }
}

/// The pod that a reviewed token is bound to; none unless it is good, and for us.
fn proof(review: &TokenReview) -> Option<Proof> {
    let status = review.status.as_ref()?;
    let for_us = status.audiences.as_ref().is_some_and(|a| a.iter().any(|a| a == AUDIENCE));
    if status.authenticated != Some(true) || !for_us {
        return None;
    }
    let extra = status.user.as_ref()?.extra.as_ref()?;
    let pod_uid = extra.get("authentication.kubernetes.io/pod-uid")?.first()?.clone();
    Some(Proof { pod_uid })
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;
    use crate::tests::{context, not_found, serve_on, step};

    #[tokio::test]
    async fn the_certificate_is_another_when_it_is_due_whether_or_not_the_first_try_does_it() {
        const SECRET: &str = "/api/v1/namespaces/rayherd/secrets/authority";
        let (context, mut server) = context();
        // the first operator makes the authority
        let makes = vec![
            step("GET", SECRET, 404, not_found()),
            step("POST", "/api/v1/namespaces/rayherd/secrets?", 201, json!({"metadata": {}})),
        ];
        let (serving, said) = tokio::join!(certificate(&context), serve_on(&mut server, makes));
        let serving = serving.unwrap();
        assert!(serving.renew > Timestamp::now().as_second() + 7 * 24 * 3600);
        let trusted = context.trusted.read().unwrap().clone();
        assert_eq!(trusted.matches("BEGIN CERTIFICATE").count(), 1);
        let current = Current::new(serving.key);
        let before = current.now();
        tokio::spawn(renew(context.clone(), current.clone(), 0, Duration::from_millis(10)));
        // it goes on with the one that it has, tries again, and then is silent for as long as that one is good
        let away = json!({"kind": "Status", "apiVersion": "v1", "status": "Failure", "code": 500, "message": "etcd"});
        serve_on(&mut server, vec![step("GET", SECRET, 500, away), step("GET", SECRET, 200, said[1].clone())]).await;
        assert!(!Arc::ptr_eq(&before, &current.now()));
        assert_ne!(before.cert, current.now().cert);
        assert_eq!(*context.trusted.read().unwrap(), trusted, "of the same root");
        assert_eq!(context.metrics.errors.get(), 1);
    }

    #[test]
    fn only_a_good_token_for_us_that_is_bound_to_a_pod_proves_one() {
        let review = |status: Value| -> TokenReview {
            serde_json::from_value(json!({"metadata": {}, "spec": {}, "status": status})).unwrap()
        };
        let user = json!({"username": "x", "extra": {"authentication.kubernetes.io/pod-uid": ["p-1"]}});
        let good = json!({"authenticated": true, "audiences": ["rayherd"], "user": user});
        assert_eq!(proof(&review(good.clone())), Some(Proof { pod_uid: "p-1".into() }));
        for (field, value) in [
            ("authenticated", json!(false)),
            ("audiences", json!(["other"])),
            ("audiences", json!(null)),
            ("user", json!({"username": "x"})),
            ("user", json!({"username": "x", "extra": {"authentication.kubernetes.io/pod-uid": []}})),
        ] {
            let mut bad = good.clone();
            bad[field] = value;
            assert_eq!(proof(&review(bad)), None, "{field}");
        }
    }
}
