use std::sync::Arc;

use super::super::conformance::conformance;
use super::super::s3_server::{BUCKET, S3Faults, S3Server};
use super::super::{RetryPolicy, Retrying};
use super::*;

fn soon() -> RetryPolicy {
    RetryPolicy { attempts: 12, first: Duration::from_millis(1), longest: Duration::from_millis(8) }
}

fn wrong_key() -> S3Credentials {
    S3Key { secret_key: "wrong".to_owned(), ..S3Server::key() }.into()
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

    settings.credentials = wrong_key();
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
    wrong.credentials = wrong_key();
    let store = S3Store::new(wrong).unwrap();
    for error in [store.size("k").await.err(), store.put("k", Bytes::new()).await.err()] {
        let error = error.unwrap();
        assert!(matches!(&error, StoreError::Denied { .. }), "{error:?}");
        assert!(error.to_string().contains("SignatureDoesNotMatch"), "{error}");
    }
}

#[tokio::test]
async fn a_refusal_says_what_to_do() {
    let server = S3Server::start().await;
    let store = S3Store::connect(server.settings("p")).await.unwrap();
    for (code, status, part) in [
        ("AccessDenied", 403, "allowed to list, get, put and delete objects"),
        ("InvalidAccessKeyId", 403, "does not know this key"),
        ("XMinioStorageFull", 507, "no room for k (7 bytes): free some or add some"),
    ] {
        let error =
            store.classify("put", "k".into(), 7, status, code, format!("{code}: no (HTTP {status})")).to_string();
        assert!(error.contains(part), "{error}");
    }
}

/// A store that sends files in parts of so many bytes.
async fn in_parts(server: &S3Server, least: u64) -> S3Store {
    S3Store { parts: Parts { above: least, least }, ..S3Store::connect(server.settings("p")).await.unwrap() }
}

#[tokio::test]
async fn a_large_file_goes_in_parts_and_on_where_it_broke_off() {
    let server = S3Server::start().await;
    let store = in_parts(&server, 1000).await;
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    // the last part is shorter; no two are alike
    let body: Vec<u8> = (0..7600_u32).map(|i| (i % 251) as u8 ^ (i / 1000) as u8).collect();
    std::fs::write(&file, &body).unwrap();
    store.put_file("whole", &file).await.unwrap();
    assert!(store.get("whole").await.unwrap() == body[..]);
    assert_eq!((server.uploads(), store.sent().load(Ordering::Relaxed)), ((8, vec![]), 7600));

    // breaks off: some parts are there, and the upload stays
    let mut seed = 0;
    let before = loop {
        server.set_faults(S3Faults { seed, unavailable: 250, ..S3Faults::default() });
        let before = server.uploads().0;
        let broken = store.put_file("on", &file).await;
        let (after, left) = server.uploads();
        seed += 1;
        if matches!(broken, Err(StoreError::Unavailable { .. })) && !left.is_empty() && after > before + 1 {
            break after;
        }
        // all at once, or nothing yet: another draw
        server.set_faults(S3Faults::default());
        store.put_file("on", &file).await.unwrap();
        store.delete(&["on".to_owned()]).await.unwrap();
        assert!(seed < 200, "no draw of faults breaks it off in the middle");
    };
    server.set_faults(S3Faults::default());
    let (there, sent) = (store.size("on").await.unwrap(), store.sent().load(Ordering::Relaxed));
    assert_eq!(there, None, "not there by half");
    // another process
    in_parts(&server, 1000).await.put_file("on", &file).await.unwrap();
    let (after, left) = server.uploads();
    assert!(after - before < 8, "{} parts were sent again", after - before);
    assert_eq!((left, store.sent().load(Ordering::Relaxed)), (vec![], sent));
    assert!(store.get("on").await.unwrap() == body[..]);
}

/// What the parts that are there hold counts, not that they are there.
#[tokio::test]
async fn an_upload_of_another_file_is_not_gone_on_with() {
    let server = S3Server::start().await;
    let store = in_parts(&server, 1000).await;
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    let upload = store.begin("k").await.unwrap();
    std::fs::write(&file, [1; 2500]).unwrap();
    store.send_all("k", &file, 2500, &upload, &Default::default()).await.unwrap();
    let body: Vec<u8> = [[1; 1000], [2; 1000]].concat();
    std::fs::write(&file, &body).unwrap();
    store.put_file("k", &file).await.unwrap();
    assert!(store.get("k").await.unwrap() == body[..]);
    // the second part alone was another one: 3, and 1
    assert_eq!(server.uploads(), (4, vec![]));
    // nothing is left of what cannot be: the file ends before it should
    let upload = store.begin("l").await.unwrap();
    let error = store.send_all("l", &file, 2500, &upload, &Default::default()).await.unwrap_err();
    assert!(matches!(error, StoreError::Misconfigured { .. }), "{error:?}");
    assert!(store.put_parts("l", &file, 2500).await.is_err());
    assert_eq!(server.uploads().1, Vec::<String>::new(), "given up");
}

#[tokio::test]
async fn files_in_parts_over_a_bad_network() {
    let server = S3Server::start().await;
    let store = Retrying::new(Arc::new(in_parts(&server, 1000).await), RetryPolicy { attempts: 200, ..soon() });
    let latency = Duration::from_micros(200);
    server.set_faults(S3Faults { seed: 11, unavailable: 100, starting: 40, lost_reply: 100, cut_body: 60, latency });
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    for number in 0..4 {
        let body: Vec<u8> = (0..9100 + number).map(|i| (i % 251) as u8).collect();
        std::fs::write(&file, &body).unwrap();
        store.put_file("k", &file).await.unwrap();
        assert!(store.get("k").await.unwrap() == body[..]);
    }
    assert!(store.retries() > 4, "{} retries", store.retries());
}

#[tokio::test]
async fn a_bucket_is_made_once() {
    let server = S3Server::start().await;
    let store = S3Store::new(S3Settings { bucket: "another".to_owned(), ..server.settings("") }).unwrap();
    assert!(matches!(store.list("").await, Err(StoreError::NoBucket { .. })));
    store.make_bucket().await.unwrap();
    store.make_bucket().await.unwrap();
    assert_eq!(store.list("").await.unwrap(), []);
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

    // a cloud's identity where there is no key, and only there
    for (names, want) in [
        (&["AWS_WEB_IDENTITY_TOKEN_FILE"][..], Some(Identity::WebToken)),
        (&["AWS_CONTAINER_CREDENTIALS_FULL_URI"], Some(Identity::Container)),
        (&["AWS_CONTAINER_CREDENTIALS_RELATIVE_URI"], Some(Identity::Container)),
        (&["AWS_WEB_IDENTITY_TOKEN_FILE", "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"], None),
    ] {
        let variable = |name: &str| names.contains(&name).then(|| "x".to_owned());
        let found = S3Settings::from_url_and("s3://scenes", None, variable).unwrap().credentials;
        match want {
            Some(identity) => assert_eq!(found, S3Credentials::Identity(identity)),
            None => assert!(matches!(found, S3Credentials::Key(_)), "{found:?}"),
        }
    }
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
        // above what goes in one put, gone on with after a part of it
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        let body: Vec<u8> = (0..70_000_001_u32).map(|i| (i >> 12) as u8 ^ i as u8).collect();
        std::fs::write(&file, &body).unwrap();
        let upload = store.begin("conformance/parts").await.unwrap();
        store.send("conformance/parts", file.clone(), &upload, 1, (0, 8 << 20), None).await.unwrap();
        assert_eq!(store.unfinished("conformance/parts").await.unwrap().as_deref(), Some(&*upload));
        let known = store.parts_of("conformance/parts", &upload).await.unwrap();
        assert_eq!(known.into_iter().map(|(number, (size, _))| (number, size)).collect::<Vec<_>>(), [(1, 8 << 20)]);
        store.put_file("conformance/parts", &file).await.unwrap();
        assert!(store.get("conformance/parts").await.unwrap() == body[..]);
        assert_eq!(store.unfinished("conformance/parts").await.unwrap(), None);
        store.delete(&["conformance/parts".to_owned()]).await.unwrap();
        S3Store::new(S3Settings { bucket: "made-here".to_owned(), ..settings.clone() })
            .unwrap()
            .make_bucket()
            .await
            .unwrap();
        // MinIO on a file system cannot hold both, S3 can
        store.put("folder/object", Bytes::new()).await.unwrap();
        let clash = store.put("folder/object/below", Bytes::new()).await;
        assert!(matches!(clash, Ok(()) | Err(StoreError::InvalidKey { .. })), "{clash:?}");
        if clash.is_ok() {
            store.delete(&["folder/object/below".to_owned()]).await.unwrap();
        }
        store.delete(&["folder/object".to_owned()]).await.unwrap();

        let S3Credentials::Key(key) = settings.credentials.clone() else { panic!("no key in the environment") };
        let wrong = S3Key { secret_key: "wrong".to_owned(), ..key };
        let error = S3Store::connect(S3Settings { credentials: wrong.into(), ..settings.clone() }).await.unwrap_err();
        assert!(matches!(&error, StoreError::Denied { .. }), "{error:?}");
        let error = S3Store::connect(S3Settings { bucket: "no-such-bucket".to_owned(), ..settings }).await.unwrap_err();
        assert!(matches!(&error, StoreError::NoBucket { .. }), "{error:?}");
    }
}

#[tokio::test]
async fn a_listing_tells_contents_apart() {
    let server = S3Server::start().await;
    let store = S3Store::connect(server.settings("p")).await.unwrap();
    let tag = async |key: &str| {
        let listed = store.list_versions("").await.unwrap().expect("S3 has tags");
        let found = listed.into_iter().find(|v| v.key == key).unwrap();
        assert_eq!(found.bytes, 4);
        found.tag
    };
    store.put("a", Bytes::from_static(b"body")).await.unwrap();
    store.put("b", Bytes::from_static(b"body")).await.unwrap();
    let first = tag("a").await;
    // MD5 of "body", as S3 has it for what is put in one piece
    assert_eq!(first, "841a2d689ad86bd1611447453c22c6fc");
    assert_eq!(tag("b").await, first);
    store.put("a", Bytes::from_static(b"Body")).await.unwrap();
    assert_ne!(tag("a").await, first);
    store.put("a", Bytes::from_static(b"body")).await.unwrap();
    assert_eq!(tag("a").await, first);
    // in pages as well
    for i in 0..1001 {
        server.put_raw(Box::leak(format!("p/many/{i}").into_boxed_str()), b"x");
    }
    assert_eq!(store.list_versions("many/").await.unwrap().map(|v| v.len()), Some(1001));
}
