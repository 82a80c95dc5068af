use std::sync::Arc;

use super::super::conformance::conformance;
use super::super::s3_server::{BUCKET, S3Faults, S3Server};
use super::super::{RetryPolicy, Retrying};
use super::*;

fn soon() -> RetryPolicy {
    RetryPolicy { attempts: 12, first: Duration::from_millis(1), longest: Duration::from_millis(8) }
}

#[tokio::test]
async fn conforms() {
    let server = S3Server::start().await;
    for prefix in ["", "scenes/one"] {
        conformance(&S3Store::connect(server.settings(prefix)).await.unwrap()).await;
    }
}

#[tokio::test]
async fn conforms_over_a_bad_network() {
    let server = S3Server::start().await;
    let store = S3Store::connect(server.settings("p")).await.unwrap();
    let latency = Duration::from_micros(200);
    server.set_faults(S3Faults { seed: 11, unavailable: 60, starting: 40, lost_reply: 40, cut_body: 60, latency });
    let store = Retrying::new(Arc::new(store), soon());
    conformance(&store).await;
    let (requests, injected) = server.requests();
    let retries = store.retries();
    // an empty body cannot be cut, and the client repeats by itself what a closed connection never took
    assert!(injected > requests / 20 && retries > injected / 2, "{injected} of {requests}, {retries} retries");
}

#[tokio::test]
async fn what_goes_wrong_is_named_by_what_can_be_done() {
    let server = S3Server::start().await;
    let mut settings = server.settings("p");
    let store = S3Store::connect(settings.clone()).await.unwrap();
    store.put("k", Bytes::from_static(b"a body")).await.unwrap();

    let only =
        |unavailable, lost_reply, cut_body| S3Faults { unavailable, lost_reply, cut_body, ..S3Faults::default() };
    for (faults, part) in
        [(only(1000, 0, 0), "SlowDown: on purpose (HTTP 503)"), (only(0, 1000, 0), ""), (only(0, 0, 1000), "")]
    {
        server.set_faults(faults);
        let error = store.get("k").await.unwrap_err();
        assert!(matches!(&error, StoreError::Unavailable { .. }), "{faults:?}: {error:?}");
        assert!(error.to_string().contains(part), "{error}");
    }
    server.set_faults(only(0, 1000, 0));
    assert!(matches!(store.put("l", Bytes::new()).await, Err(StoreError::Unavailable { .. })));
    server.set_faults(S3Faults::default());
    assert_eq!(store.size("l").await.unwrap(), Some(0), "the reply was lost, not the object");

    settings.credentials.secret_key = "wrong".to_owned();
    let error = S3Store::connect(settings.clone()).await.unwrap_err();
    assert!(matches!(&error, StoreError::Denied { .. }), "{error:?}");
    settings = S3Settings { bucket: "no-such-bucket".to_owned(), ..server.settings("") };
    let error = S3Store::connect(settings.clone()).await.unwrap_err();
    assert!(error.to_string().contains("there is no bucket no-such-bucket: create it"), "{error}");

    drop(server);
    settings.endpoint = Some("http://127.0.0.1:1".to_owned());
    let error = S3Store::connect(settings).await.unwrap_err();
    assert!(matches!(&error, StoreError::Unavailable { .. }), "{error:?}");
    assert!(error.to_string().contains("refused"), "{error}");
}

/// MinIO of 2021 answers with a bare 403 while it starts, also what a HEAD is answered with when it is denied.
#[tokio::test]
async fn a_refusal_without_a_reason_passes_one_with_a_reason_does_not() {
    let server = S3Server::start().await;
    let settings = server.settings("p");
    let store = S3Store::connect(settings.clone()).await.unwrap();
    store.put("k", Bytes::from_static(b"a body")).await.unwrap();
    server.set_faults(S3Faults { starting: 1000, ..S3Faults::default() });
    let keys = ["k".to_owned()];
    let refused = [
        store.put("k", Bytes::new()).await.err(),
        store.get("k").await.err(),
        store.size("k").await.err(),
        store.list("").await.err(),
        store.delete(&keys).await.err(),
        S3Store::connect(settings.clone()).await.err(),
    ];
    for error in refused {
        let error = error.unwrap();
        assert!(matches!(&error, StoreError::Unavailable { .. }), "{error:?}");
        assert!(error.to_string().contains("HTTP 403, without a reason: the server may still be starting"), "{error}");
    }
    // one that comes up meanwhile
    server.set_faults(S3Faults { seed: 3, starting: 500, ..S3Faults::default() });
    let patient = Retrying::new(Arc::new(store.clone()), soon());
    for _ in 0..20 {
        assert_eq!(patient.size("k").await.unwrap(), Some(6));
    }
    assert!(patient.retries() > 0);
    server.set_faults(S3Faults::default());
    assert_eq!(store.get("k").await.unwrap(), "a body");

    let mut wrong = settings;
    wrong.credentials.secret_key = "wrong".to_owned();
    let store = S3Store::new(wrong).unwrap();
    for error in [store.size("k").await.err(), store.put("k", Bytes::new()).await.err()] {
        let error = error.unwrap();
        assert!(matches!(&error, StoreError::Denied { .. }), "{error:?}");
        assert!(error.to_string().contains("SignatureDoesNotMatch"), "{error}");
    }
}

/// The TLS client is there and its crypto provider chosen: without one, rustls panics at the first connection.
#[tokio::test]
async fn tls_to_a_server_that_speaks_none_is_an_error() {
    let server = S3Server::start().await;
    let mut settings = server.settings("");
    settings.endpoint = settings.endpoint.map(|e| e.replace("http://", "https://"));
    let error = S3Store::connect(settings).await.unwrap_err();
    assert!(matches!(&error, StoreError::Unavailable { .. }), "{error:?}");
}

#[tokio::test]
async fn sees_only_its_prefix_and_only_keys() {
    let server = S3Server::start().await;
    let store = S3Store::connect(server.settings("a/b")).await.unwrap();
    for path in ["a/b/k", "a/bc", "a/b/with space", "a/b/.hidden", "a/b/folder/", "k"] {
        server.put_raw(path, b"x");
    }
    assert_eq!(store.list("").await.unwrap(), [("k".to_owned(), 1)]);
    assert_eq!(store.describe(), format!("s3://{BUCKET}/a/b"));
}

#[test]
fn settings_come_from_url_and_environment() {
    let environment = |name: &str| match name {
        "AWS_ACCESS_KEY_ID" => Some("id".to_owned()),
        "AWS_SECRET_ACCESS_KEY" => Some("hush".to_owned()),
        "AWS_DEFAULT_REGION" => Some("eu-north-1".to_owned()),
        _ => None,
    };
    let parse = |url, endpoint| S3Settings::from_url_and(url, endpoint, environment);
    let s = parse("s3://scenes/a/b/", Some("http://minio:9000")).unwrap();
    assert_eq!((s.bucket.as_str(), s.prefix.as_str(), s.url().as_str()), ("scenes", "a/b", "s3://scenes/a/b"));
    assert_eq!((s.region.as_str(), s.path_style), ("eu-north-1", true));
    assert!(!format!("{s:?}").contains("hush"));
    let s = parse("s3://scenes", None).unwrap();
    assert_eq!((s.endpoint, s.path_style, s.prefix.as_str()), (None, false, ""));

    for (url, endpoint, part) in [
        ("scenes/a", None, "s3://bucket/prefix"),
        ("s3://", None, "bucket's name"),
        ("s3://Upper", None, "bucket's name"),
        ("s3://scenes//a", None, "empty segment"),
        ("s3://scenes/../a", None, "dot"),
        ("s3://scenes", Some("minio:9000"), "http://"),
        ("s3://scenes", Some("http://"), "http://"),
    ] {
        let error = parse(url, endpoint).unwrap_err().to_string();
        assert!(error.contains(part), "{url} {endpoint:?}: {error}");
    }
    let error = S3Settings::from_url_and("s3://scenes", None, |_| None).unwrap_err().to_string();
    assert!(error.contains("AWS_ACCESS_KEY_ID is not set"), "{error}");
}

/// Against a real server: `RAYHERD_S3_ENDPOINT` and `RAYHERD_S3_BUCKET`, credentials as in [`S3Settings::from_url`].
/// `tests/minio/run` starts one and sets them.
#[tokio::test]
#[ignore = "needs an S3 server: run tests/minio/run, which starts MinIO and calls this"]
async fn conforms_on_a_real_server() {
    let variable = |name: &str| std::env::var(name).unwrap_or_else(|_| panic!("{name} is not set"));
    let (endpoint, bucket) = (variable("RAYHERD_S3_ENDPOINT"), variable("RAYHERD_S3_BUCKET"));
    for url in [format!("s3://{bucket}"), format!("s3://{bucket}/some/prefix")] {
        let settings = S3Settings::from_url(&url, Some(&endpoint)).unwrap();
        let store = S3Store::connect(settings.clone()).await.unwrap();
        conformance(&store).await;
        // MinIO on a file system cannot hold both, S3 can
        store.put("folder/object", Bytes::new()).await.unwrap();
        let clash = store.put("folder/object/below", Bytes::new()).await;
        assert!(matches!(clash, Ok(()) | Err(StoreError::InvalidKey { .. })), "{clash:?}");
        if clash.is_ok() {
            store.delete(&["folder/object/below".to_owned()]).await.unwrap();
        }
        store.delete(&["folder/object".to_owned()]).await.unwrap();

        let mut wrong = settings.clone();
        wrong.credentials.secret_key = "wrong".to_owned();
        let error = S3Store::connect(wrong).await.unwrap_err();
        assert!(matches!(&error, StoreError::Denied { .. }), "{error:?}");
        let error = S3Store::connect(S3Settings { bucket: "no-such-bucket".to_owned(), ..settings }).await.unwrap_err();
        assert!(matches!(&error, StoreError::NoBucket { .. }), "{error:?}");
    }
}
