//! Stores that go, come back empty, or are too few.

use super::*;

#[test]
fn a_store_that_goes_while_rays_wait_costs_copies_and_no_byte() {
    let spec = spec(Strategy::SchedulingGridOverlapReduced, 4, 2);
    let (cluster, kept) = (Cluster::new(3), Arc::new(Kept::default()));
    let done = cluster.beside(
        (&spec, &kept, "e"),
        |job| job,
        |_, _| {
            wait_for(|| kept.newest(0).unwrap().is_some_and(|p| p.0 >= 3));
            cluster.stores[1].lose();
        },
    );
    if let Err(e) = done {
        panic!("{e}");
    }
    assert!(cluster.picture(2) == expected(&spec));
    assert_eq!(kept.reports.lock().unwrap()[0].tasks_redone, 0);
}

#[test]
fn a_machine_whose_plug_is_pulled_costs_its_copies_and_no_byte() {
    let mut spec = spec(Strategy::SchedulingGridOverlapReduced, 4, 2);
    spec.task_seconds = Some(0.003);
    let (cluster, kept) = (Cluster::new(3), Arc::new(Kept::default()));
    let done = cluster.beside(
        (&spec, &kept, "e"),
        |job| Job { patience: Duration::ZERO, ..job },
        |_, _| {
            wait_for(|| kept.newest(0).unwrap().is_some_and(|p| p.0 >= 3));
            cluster.stores[1].hang(true);
        },
    );
    if let Err(e) = done {
        panic!("{e}");
    }
    assert!(cluster.picture(2) == expected(&spec));
    assert_eq!(kept.reports.lock().unwrap()[0].tasks_redone, 0);
    // who asked it when the plug was pulled, and nobody later
    assert!(cluster.stores[1].hung() < 40, "{} requests were left hanging", cluster.stores[1].hung());
    let below = kept.below.lock().unwrap();
    assert!(below[0].as_ref().is_some_and(|m| m.contains("store 1 is silent")), "{below:?}");
    assert_eq!(below.last(), Some(&None), "all was copied: {below:?}");
    // of two copies of everything in the scene both are on the stores that are left
    let objects = |store: usize| -> Vec<String> {
        let listed = cluster.runtime.block_on(cluster.stores[store].list("objects/")).unwrap();
        listed.into_iter().map(|(key, _)| key).collect()
    };
    assert!(objects(0).len() > 8, "{:?}", objects(0));
    assert_eq!(objects(0), objects(2));
}

#[test]
fn a_server_that_comes_back_without_its_bucket_costs_its_copies_and_no_byte() {
    let mut spec = spec(Strategy::SchedulingGridOverlapReduced, 4, 2);
    spec.task_seconds = Some(0.003);
    let (cluster, kept) = (Cluster::new(3), Arc::new(Kept::default()));
    let done = cluster.beside(
        (&spec, &kept, "e"),
        // far longer than the test may take: it is no silence
        |job| Job { patience: Duration::from_secs(3600), ..job },
        |_, _| {
            wait_for(|| kept.newest(0).unwrap().is_some_and(|p| p.0 >= 3));
            cluster.stores[1].empty();
        },
    );
    if let Err(e) = done {
        panic!("{e}");
    }
    let want = expected(&spec);
    assert!(cluster.picture(2) == want);
    assert_eq!(kept.reports.lock().unwrap()[0].tasks_redone, 0);
    let below = kept.below.lock().unwrap().clone();
    assert!(below[0].as_ref().is_some_and(|m| m.contains("store 1 has lost its bucket")), "{below:?}");
    assert_eq!(below.last(), Some(&None), "all was copied: {below:?}");
    let objects = |store: usize| cluster.runtime.block_on(cluster.stores[store].list("objects/")).unwrap();
    assert!(objects(0).len() > 8 && objects(0) == objects(2));
    // another job begins beside it, its scene prepared anew; and with its bucket it is a server again
    let other = RenderJobSpec { splits: Some(3), ..spec.clone() };
    let kept = Arc::new(Kept::default());
    cluster.beside((&other, &kept, "f"), |job| Job { prefix: "jobs/2".into(), ..job }, |_, _| {}).unwrap();
    assert!(!kept.prepared.lock().unwrap()[0].1);
    cluster.stores[1].restore(Some(Arc::new(MemoryStore::default())));
    let kept = Arc::new(Kept::default());
    cluster.beside((&spec, &kept, "g"), |job| Job { prefix: "jobs/3".into(), ..job }, |_, _| {}).unwrap();
    assert!(cluster.picture(1) == want);
    // nobody has it: that is said, and at once
    cluster.stores.iter().for_each(|s| s.empty());
    let kept = Arc::new(Kept::default());
    let said = cluster.beside((&spec, &kept, "h"), |job| Job { prefix: "jobs/4".into(), ..job }, |_, _| {});
    assert!(said.unwrap_err().to_string().contains("none of the job's servers has the bucket"));
}

#[test]
fn a_scene_that_two_workers_prepare_lies_whole_on_two_stores_and_is_read_by_any_number() {
    let mut spec = spec(Strategy::SchedulingGridOverlapReduced, 6, 2);
    spec.workers.nodes = Some(2);
    let (cluster, kept) = (Cluster::new(6), Arc::new(Kept::default()));
    // three workers here, of whom the job's spec does not know
    cluster.render(&spec, &kept).unwrap();
    let want = expected(&spec);
    assert!(cluster.picture(0) == want);
    let reference = kept.prepared.lock().unwrap()[0].0;
    let part = cluster.depot(None).replicated(2).unwrap();
    let objects = Arc::new(SceneObjects::new(Arc::new(part), cluster.runtime.handle().clone()).unwrap());
    let manifest = Manifest::load(objects.as_ref(), &reference).unwrap();
    assert_eq!(manifest.homes.as_ref().map(Vec::len), Some(2));
    let lies = |store: usize| -> BTreeSet<String> {
        let listed = cluster.runtime.block_on(cluster.stores[store].list("objects/")).unwrap();
        listed.into_iter().map(|(key, _)| key).collect()
    };
    let needed = PreparedScene::open(manifest, objects).unwrap();
    let blocks: BTreeSet<String> = (needed.owning_order().iter().map(|&s| &needed.manifest.splits[s as usize]))
        .flat_map(|s| [object_key(&s.geometry.hash), object_key(&s.attributes.hash)])
        .collect();
    let whole =
        |a: usize, b: usize| lies(a).union(&lies(b)).filter(|key| blocks.contains(*key)).count() == blocks.len();
    let pairs = (0..6).flat_map(|a| (a + 1..6).map(move |b| (a, b))).filter(|&(a, b)| whole(a, b)).count();
    assert!(pairs >= 1, "no two stores hold all {} blocks", blocks.len());
    let copies: usize = (0..6).map(|s| lies(s).intersection(&blocks).count()).sum();
    assert_eq!(copies, 2 * blocks.len());
    // another number of workers finds it there
    let again = RenderJobSpec { workers: Default::default(), ..spec.clone() };
    let kept = Arc::new(Kept::default());
    cluster.beside((&again, &kept, "f"), |job| Job { prefix: "jobs/2".into(), ..job }, |_, _| {}).unwrap();
    assert_eq!(*kept.prepared.lock().unwrap(), [(reference, true)]);
    assert!(cluster.picture(1) == want);
}

#[test]
fn more_copies_than_servers_are_refused() {
    let (cluster, kept) = (Cluster::new(2), Arc::new(Kept::default()));
    let said = cluster.render(&spec(Strategy::Auto, 2, 3), &kept).unwrap_err().to_string();
    assert!(said.contains("spec.replicas is 3, but the storage has 2 server(s)"), "{said}");
}
