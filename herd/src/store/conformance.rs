//! What every store and every layer around one must do. One suite; each backend's tests run it.

use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};

use super::{BlockStore, StoreError};

/// Checks a store against the contract of [`BlockStore`]; works below `conformance/` and cleans up.
///
/// # Panics
/// When the store breaks the contract.
pub async fn conformance(store: &dyn BlockStore) {
    remove(store, "conformance/").await;
    reads_back_what_was_put(store).await;
    reads_back_what_a_file_held(store).await;
    replaces(store).await;
    says_not_found(store).await;
    refuses_invalid_keys(store).await;
    takes_awkward_keys(store).await;
    lists_by_string_prefix(store).await;
    lists_more_than_a_page(store).await;
    readers_see_one_whole_version(store).await;
    assert!(!store.describe().is_empty());
    assert_eq!(list(store, "conformance/").await, [], "what was deleted is gone");
}

async fn reads_back_what_was_put(store: &dyn BlockStore) {
    for (name, length) in [("empty", 0), ("one", 1), ("large", 8 << 20)] {
        let key = format!("conformance/body/{name}");
        let body = pattern(length, 1);
        store.put(&key, body.clone()).await.unwrap();
        assert!(store.get(&key).await.unwrap() == body, "{name}");
        assert_eq!(store.size(&key).await.unwrap(), Some(length as u64), "{name}");
    }
    let found = list(store, "conformance/body/").await;
    let sizes = [("conformance/body/empty", 0), ("conformance/body/large", 8 << 20), ("conformance/body/one", 1)];
    assert_eq!(found, sizes.map(|(k, n)| (k.to_owned(), n)));
    remove(store, "conformance/body/").await;
}

async fn reads_back_what_a_file_held(store: &dyn BlockStore) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    for length in [0, 5, (3 << 20) + 1] {
        let body = pattern(length, 2);
        std::fs::write(&file, &body).unwrap();
        let key = "conformance/file";
        store.put_file(key, &file).await.unwrap();
        assert!(store.get(key).await.unwrap() == body, "{length}");
        // over what was there, and was longer
        let copy = folder.path().join("copy");
        std::fs::write(&copy, vec![7; 4 << 20]).unwrap();
        assert_eq!(store.get_file(key, &copy).await.unwrap(), length as u64);
        assert!(std::fs::read(&copy).unwrap() == body, "{length}");
        store.delete(&[key.to_owned()]).await.unwrap();
        assert!(matches!(store.get_file(key, &copy).await, Err(StoreError::NotFound { .. })));
    }
    let gone = store.get_file("conformance/file", &folder.path().join("copy")).await;
    assert!(matches!(gone, Err(StoreError::NotFound { .. })), "{gone:?}");
    assert!(store.put_file("conformance/file", &folder.path().join("none")).await.is_err());
}

async fn replaces(store: &dyn BlockStore) {
    let key = "conformance/replaced";
    for body in ["first", "", "the third and longest"] {
        store.put(key, Bytes::from(body)).await.unwrap();
        assert_eq!(store.get(key).await.unwrap(), body);
        assert_eq!(store.size(key).await.unwrap(), Some(body.len() as u64));
    }
    assert_eq!(list(store, key).await.len(), 1);
    store.delete(&[key.to_owned()]).await.unwrap();
}

async fn says_not_found(store: &dyn BlockStore) {
    let key = "conformance/absent/object";
    let absent = async || {
        match store.get(key).await {
            Err(StoreError::NotFound { key: named, .. }) => assert_eq!(named, key),
            other => panic!("get of an absent object: {other:?}"),
        }
        assert_eq!(store.size(key).await.unwrap(), None);
        assert_eq!(list(store, "conformance/absent/").await, []);
    };
    absent().await;
    store.delete(&[key.to_owned()]).await.expect("deleting what is not there is no error");
    store.delete(&[]).await.expect("nor is deleting nothing");
    store.put(key, Bytes::from_static(b"x")).await.unwrap();
    let twice = [key.to_owned(), "conformance/never".to_owned(), key.to_owned()];
    store.delete(&twice).await.expect("one key may be named twice");
    absent().await;
    store.delete(&twice).await.expect("deleting again is deleting nothing");
    store.put(key, Bytes::from_static(b"y")).await.unwrap();
    assert_eq!(store.get(key).await.unwrap(), "y", "what was deleted can be put again");
    store.delete(&[key.to_owned()]).await.unwrap();
    absent().await;
}

async fn refuses_invalid_keys(store: &dyn BlockStore) {
    let long_segment = "x".repeat(201);
    let long_key = "x/".repeat(400) + "x";
    let keys = ["", "/", "/a", "a/", "a//b", ".", "..", "a/../b", "a/.", ".tmp/x", "a b", "a\\b", "ä", "a\0", "a?b"];
    for key in keys.into_iter().chain([long_segment.as_str(), long_key.as_str()]) {
        let refused = |r: Result<(), StoreError>, what: &str| {
            assert!(matches!(r, Err(StoreError::InvalidKey { .. })), "{what} {key:?}: {r:?}");
        };
        refused(store.put(key, Bytes::from_static(b"x")).await, "put");
        refused(store.get(key).await.map(drop), "get");
        refused(store.size(key).await.map(drop), "size");
        refused(store.delete(&[key.to_owned()]).await, "delete");
    }
    for prefix in ["/", "//", "a//", "../", "a/.", "ä"] {
        let listed = store.list(prefix).await;
        assert!(matches!(listed, Err(StoreError::InvalidKey { .. })), "list {prefix:?}: {listed:?}");
    }
}

async fn takes_awkward_keys(store: &dyn BlockStore) {
    let segment = "x".repeat(200);
    // a key's length is limited too, and a store's own prefix takes its part
    let long = format!("conformance/awkward/{segment}/{segment}/{segment}");
    let deep = format!("conformance/awkward/{}z", "a/".repeat(40));
    let names = ["A", "a", "-", "_", "--x", "a.b..c", "x.", "index.html", "con", "0"];
    let mut keys: Vec<String> = names.iter().map(|n| format!("conformance/awkward/{n}_/{n}")).collect();
    keys.extend([long, deep]);
    for (i, key) in keys.iter().enumerate() {
        store.put(key, Bytes::from(i.to_string())).await.unwrap_or_else(|e| panic!("{key}: {e}"));
    }
    for (i, key) in keys.iter().enumerate() {
        assert_eq!(store.get(key).await.unwrap(), i.to_string(), "{key}");
    }
    keys.sort();
    let found: Vec<String> = list(store, "conformance/awkward/").await.into_iter().map(|(k, _)| k).collect();
    assert_eq!(found, keys);
    remove(store, "conformance/awkward/").await;
}

async fn lists_by_string_prefix(store: &dyn BlockStore) {
    // '-' and '.' sort before '/', '0' after it: walking folders in order is not enough
    let names = ["a-/x", "a./x", "a/x", "a/y/z", "a0", "ab/x", "b"];
    for name in names {
        store.put(&format!("conformance/prefix/{name}"), Bytes::from_static(b"12")).await.unwrap();
    }
    let cases: [(&str, &[&str]); 8] = [
        ("", &names),
        ("a", &names[..6]),
        ("a/", &["a/x", "a/y/z"]),
        ("a/y", &["a/y/z"]),
        ("a/y/z", &["a/y/z"]),
        ("a/y/z/", &[]),
        ("ab", &["ab/x"]),
        ("c", &[]),
    ];
    for (prefix, expected) in cases {
        let found = list(store, &format!("conformance/prefix/{prefix}")).await;
        let expected: Vec<_> = expected.iter().map(|n| (format!("conformance/prefix/{n}"), 2)).collect();
        assert_eq!(found, expected, "prefix {prefix:?}");
    }
    let everything = store.list("").await.unwrap();
    assert!(everything.is_sorted() && everything.iter().any(|(k, _)| k == "conformance/prefix/a/y/z"));
    assert_eq!(list(store, "conformance/pre").await.len(), names.len());
    remove(store, "conformance/prefix/").await;
}

async fn lists_more_than_a_page(store: &dyn BlockStore) {
    let keys: Vec<String> = (0..1234).map(|i| format!("conformance/many/{i:04}")).collect();
    let put = stream::iter(&keys).map(|key| store.put(key, Bytes::from_static(b"abc")));
    put.buffer_unordered(16).try_collect::<()>().await.unwrap();
    let expected: Vec<_> = keys.iter().map(|k| (k.clone(), 3)).collect();
    assert_eq!(list(store, "conformance/many/").await, expected);
    store.delete(&keys).await.unwrap();
    assert_eq!(list(store, "conformance/many/").await, []);
}

/// Writers replace one object while readers read it: each read is one writer's body from beginning to end.
async fn readers_see_one_whole_version(store: &dyn BlockStore) {
    let key = "conformance/contended";
    let body = |writer: u8| pattern(100_000 + 1000 * usize::from(writer), writer);
    store.put(key, body(0)).await.unwrap();
    let write = async |writer: u8| {
        for _ in 0..4 {
            store.put(key, body(writer)).await.unwrap();
        }
    };
    let read = async || {
        for _ in 0..16 {
            let seen = store.get(key).await.unwrap();
            assert!((0..4).any(|writer| seen == body(writer)), "a torn read of {} bytes", seen.len());
        }
    };
    tokio::join!(write(1), write(2), write(3), read(), read());
    let last = store.get(key).await.unwrap();
    assert_eq!(store.size(key).await.unwrap(), Some(last.len() as u64));
    store.delete(&[key.to_owned()]).await.unwrap();
}

async fn list(store: &dyn BlockStore, prefix: &str) -> Vec<(String, u64)> {
    store.list(prefix).await.unwrap_or_else(|e| panic!("list {prefix:?}: {e}"))
}

async fn remove(store: &dyn BlockStore, prefix: &str) {
    let keys: Vec<String> = list(store, prefix).await.into_iter().map(|(k, _)| k).collect();
    store.delete(&keys).await.unwrap();
}

/// Bytes that differ by place and by `seed`, so that a shifted, cut or mixed body is seen.
fn pattern(length: usize, seed: u8) -> Bytes {
    let word =
        |i: usize| (i as u32).wrapping_mul(2_654_435_761).rotate_left(7) ^ u32::from(seed).wrapping_mul(0x0101_0101);
    (0..length).map(|i| word(i / 4).to_le_bytes()[i % 4]).collect::<Vec<u8>>().into()
}
