use super::*;

/// What every store must do.
fn conformance(store: &dyn ObjectStore) {
    let a = store.put(ObjectKind::Geometry, b"one").unwrap();
    assert_eq!(a, ObjectRef::of(b"one"));
    assert_eq!(store.put(ObjectKind::Geometry, b"one").unwrap(), a);
    let empty = store.put(ObjectKind::Attributes, b"").unwrap();
    assert_eq!(store.get(&a).unwrap(), b"one");
    assert_eq!(store.get(&empty).unwrap(), b"");
    assert!(store.has(&a).unwrap());
    let other = ObjectRef::of(b"never put");
    assert!(!store.has(&other).unwrap());
    assert!(matches!(store.get(&other), Err(ObjectError::Missing { hash, .. }) if hash == other.hash));
    let wrong_size = ObjectRef { bytes: 4, ..a };
    assert!(!store.has(&wrong_size).unwrap());
    assert!(matches!(store.get(&wrong_size), Err(ObjectError::Corrupt { .. })));
    assert_eq!(store.name("scene-1").unwrap(), None);
    store.set_name("scene-1", &a).unwrap();
    store.set_name("scene-0", &a).unwrap();
    store.set_name("scene-1", &empty).unwrap();
    assert_eq!(store.name("scene-1").unwrap(), Some(empty));
    assert_eq!(store.names().unwrap(), ["scene-0", "scene-1"]);
    for bad in ["", "a/b", "..", "A", &"x".repeat(101)] {
        assert!(matches!(store.set_name(bad, &a), Err(ObjectError::Name { .. })), "{bad}");
        assert!(matches!(store.name(bad), Err(ObjectError::Name { .. })), "{bad}");
    }
}

#[test]
fn memory_conforms() {
    conformance(&MemoryObjects::new());
}

#[test]
fn directory_conforms_and_keeps_after_reopening() {
    let folder = tempfile::tempdir().unwrap();
    conformance(&DirectoryObjects::open(folder.path()).unwrap());
    let again = DirectoryObjects::open(folder.path()).unwrap();
    assert_eq!(again.get(&ObjectRef::of(b"one")).unwrap(), b"one");
    assert_eq!(again.names().unwrap().len(), 2);
}

#[test]
fn a_flipped_bit_and_a_cut_are_found_named_and_repaired_by_putting_again() {
    let folder = tempfile::tempdir().unwrap();
    let store = DirectoryObjects::open(folder.path()).unwrap();
    let body = vec![7u8; 1000];
    let object = store.put(ObjectKind::Geometry, &body).unwrap();
    let path = store.path_of(&object.hash);
    let mut broken = body.clone();
    broken[500] ^= 1;
    for bytes in [&broken[..], &body[..999]] {
        std::fs::write(&path, bytes).unwrap();
        let error = store.get(&object).unwrap_err();
        assert!(matches!(error, ObjectError::Corrupt { hash, .. } if hash == object.hash));
        assert!(error.to_string().contains(&object.hash.to_string()));
        store.put(ObjectKind::Geometry, &body).unwrap();
        assert_eq!(store.get(&object).unwrap(), body);
    }
}

#[test]
fn an_unwritable_place_keeps_its_source() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    std::fs::write(&file, b"").unwrap();
    let error = DirectoryObjects::open(&file).unwrap_err();
    let ObjectError::Failed { source, .. } = &error else { panic!("{error}") };
    assert!(source.downcast_ref::<std::io::Error>().is_some());
    // nothing half written stays behind
    let store = DirectoryObjects::open(folder.path().join("ok")).unwrap();
    store.put(ObjectKind::Geometry, b"x").unwrap();
    let shard = store.path_of(&ObjectHash::of(b"x"));
    assert_eq!(std::fs::read_dir(shard.parent().unwrap()).unwrap().count(), 1);
}

#[test]
fn hashes_have_one_spelling() {
    let hash = ObjectHash::of(b"abc");
    assert_eq!(hash.to_string().parse::<ObjectHash>().unwrap(), hash);
    assert!(hash.to_string().to_uppercase().parse::<ObjectHash>().is_err());
    assert!("12".parse::<ObjectHash>().is_err());
    let object = ObjectRef { hash, bytes: 3 };
    let json = serde_json::to_string(&object).unwrap();
    assert_eq!(serde_json::from_str::<ObjectRef>(&json).unwrap(), object);
}
