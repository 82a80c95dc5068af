//! Whole jobs: every strategy, what is prepared once, and what is known by its hash.

use super::*;

#[test]
fn every_strategy_makes_the_bytes_of_a_local_run() {
    for (strategy, splits, memory, band, layers, slots) in [
        (Strategy::Auto, 1, None, BAND, true, 1),
        (Strategy::Auto, 6, Some("64Ki"), 1, false, 1),
        (Strategy::Auto, 6, Some("64Ki"), 1, false, 2),
        (Strategy::DemandDriven, 4, None, 11, true, 2),
        (Strategy::SchedulingGrid, 4, None, 1, true, 1),
        (Strategy::SchedulingGridOverlapReduced, 4, None, BAND, false, 2),
        (Strategy::SchedulingGridOverlapReduced, 4, None, 2, false, 1),
    ] {
        let mut spec = spec(strategy, splits, 2);
        spec.image.aovs = spec.image.aovs.filter(|_| layers);
        spec.workers.memory = memory.map(|m: &str| m.parse().unwrap());
        let profile = splits > 1;
        let (cluster, kept) = (Cluster { band, profile, slots, ..Cluster::new(2) }, Arc::new(Kept::default()));
        if let Err(e) = cluster.render(&spec, &kept) {
            panic!("{strategy}: {e}");
        }
        let (file, report) = local(&spec);
        assert!(cluster.picture(0) == file, "{strategy}");
        assert_eq!(kept.reports.lock().unwrap()[0].rel_mse, report.rel_mse, "exactly, whatever the bands");
        // what was read by nobody, as the one process knows it; all of this scene is read
        let skips = |of: &report::Report| [Skip::Splits, Skip::Textures].map(|s| of.skips[s.name()]);
        assert_eq!(skips(&kept.reports.lock().unwrap()[0]), skips(&report));
        assert!(cluster.picture(1) == cluster.picture(0));
        let reports = kept.reports.lock().unwrap();
        assert!(reports[0].tasks > 1 && reports[0].scene_passes > 0.0, "{:?}", reports[0]);
        assert_eq!(cluster.at_once.load(Ordering::Relaxed), slots, "{strategy}: attempts in the hands of one worker");
        // where rays went from task to task, none of their groups is left
        let sends = matches!(strategy, Strategy::SchedulingGrid | Strategy::SchedulingGridOverlapReduced);
        assert!(reports[0].hops > 0 || !sends, "{strategy}");
        for lies in cluster.lies() {
            let rays: Vec<&String> = lies.iter().filter(|key| key.contains("/rays/")).collect();
            assert!(!lies.is_empty() && rays.is_empty(), "{strategy}: {rays:?}");
        }
        assert_eq!(kept.pictures.lock().unwrap()[0].len(), 2);
        // what workers spent, of those of committed attempts, comes with their results
        let costs = reports[0].profile.map(|p| [Part::Shading, Part::Shadow].map(|part| p.of(part).items));
        assert_eq!(costs.is_some(), profile, "{strategy}");
        assert!(costs.is_none_or(|c| c[0] == reports[0].rays.closest && c[1] >= reports[0].rays.shadow), "{strategy}");
    }
}

/// Of what may change while a job runs: whether all tasks of a round end before the next begins.
#[test]
fn a_job_goes_on_with_another_barrier() {
    let mut spec = spec(Strategy::SchedulingGridOverlapReduced, 4, 2);
    spec.task_seconds = Some(0.003);
    for barrier in [true, false] {
        let (cluster, kept) = (Cluster::new(3), Arc::new(Kept::default()));
        spec.barrier = Some(barrier);
        begun(&cluster, &spec, &kept, 6);
        spec.barrier = Some(!barrier);
        cluster.render(&spec, &kept).unwrap();
        assert!(cluster.picture(0) == expected(&spec), "{barrier}");
        let reports = kept.reports.lock().unwrap();
        assert!(reports[0].tasks_reused > 0 && reports[0].tasks > 0, "{barrier}: {:?}", reports[0]);
    }
}

/// And the target error, also of a job that has reached the one before.
#[test]
fn a_job_whose_target_error_is_lowered_goes_on_from_where_it_ended() {
    let mut spec = spec(Strategy::SchedulingGridOverlapReduced, 4, 2);
    spec.sampling.spp = Some(1024);
    let (cluster, kept) = (Cluster::new(3), Arc::new(Kept::default()));
    let mut tasks = 0;
    for target in [0.03, 0.006] {
        spec.sampling.target_error = Some(target);
        cluster.render(&spec, &kept).unwrap();
        let (file, report) = local(&spec);
        assert!(cluster.picture(0) == file, "{target}");
        let last = kept.reports.lock().unwrap().last().unwrap().clone();
        assert!(last.target_reached == Some(true) && last.spp < 1024, "{last:?}");
        assert_eq!((last.spp, last.tasks_reused, last.tasks_redone), (report.spp, tasks, 0));
        assert!(last.tasks > 0, "{target}: it was not reached before");
        tasks = last.tasks;
    }
}

#[test]
fn a_scene_is_prepared_once_and_a_finished_job_is_not_done_again() {
    let spec = spec(Strategy::Auto, 4, 1);
    let (cluster, kept) = (Cluster::new(3), Arc::new(Kept::default()));
    cluster.render(&spec, &kept).unwrap();
    let first = cluster.picture(0);
    cluster.render(&spec, &kept).unwrap();
    assert!(cluster.picture(0) == first);
    let reports = kept.reports.lock().unwrap();
    assert_eq!((reports[1].tasks, reports[1].tasks_reused), (0, reports[0].tasks), "all of it was in the ledger");
    let prepared = kept.prepared.lock().unwrap();
    assert!(!prepared[0].1 && prepared[1].1, "{prepared:?}");
    // what was kept of it: world, four tiles, two objects of each split; and nothing was read the second time
    let skips = |i: usize| [Skip::Prepared, Skip::Volume, Skip::Splits].map(|s| reports[i].skips[s.name()]);
    let [kept_objects, cells, splits] = skips(1);
    assert_eq!((skips(0)[0], skips(0)[1], cells, kept_objects), (0, 0, 0, 5 + 2 * splits));
    assert!(splits >= 4 && skips(0)[2] < splits, "{splits}");
}

/// Pods of jobs that wait may take the room of the pod of the job that they wait for.
#[test]
fn a_job_without_workers_keeps_no_other_from_preparing_their_scene() {
    let spec = spec(Strategy::Auto, 2, 1);
    let (cluster, kept) = (Cluster::new(2), Arc::new(Kept::default()));
    let (first, depot) = (Fleet::new(3, "f"), cluster.depot(None));
    let (first, cluster, spec) = (&first, &cluster, &spec);
    std::thread::scope(|scope| {
        let keeper: Arc<dyn Keeper> = Arc::new(Kept::default());
        let depot = &depot;
        let waits = scope.spawn(move || run(&cluster.job(spec, depot, first, "f"), &keeper, &Silent));
        // nor one whose worker was there, and is gone with the work in its hands
        let poll = poll(0, "gone");
        wait_for(|| matches!(first.answer(&poll), Ok(Answer::Work { .. })));
        gone(first, 0, "gone");
        cluster.render(spec, &kept).unwrap();
        first.cancel("enough");
        assert!(matches!(waits.join().unwrap(), Err(JobError::Owned(_))));
    });
    assert!(cluster.picture(0) == expected(spec));
}

#[test]
fn a_job_whose_scene_is_known_needs_its_source_no_more() {
    let mut spec = spec(Strategy::Auto, 4, 2);
    spec.image.exposure = Some(1.5);
    let (cluster, kept) = (Cluster::new(3), Arc::new(Kept::default()));
    cluster.render(&spec, &kept).unwrap();
    // the PNG stands beside the picture, with its exposure
    let (exr, png, _) = local_files(&spec);
    assert!(cluster.picture(0) == exr);
    let shown = || cluster.runtime.block_on(cluster.stores[1].get("out/a.png")).map(|png| texels(&png));
    assert_eq!(shown().unwrap(), texels(&png));
    let scene = kept.prepared.lock().unwrap()[0].0.hash.to_string();
    // every server knows that a job has used it
    let marks = cluster.runtime.block_on(scenes::find(cluster.depot(None).stores())).unwrap();
    let used = marks.all[&scene.parse().unwrap()].used.unwrap();
    assert_eq!((marks.stores, scenes::unix_now() - used < 600), (3, true));
    cluster.runtime.block_on(cluster.stores[0].delete(&[SOURCE.to_owned(), TEXTURE.to_owned()])).unwrap();
    let again = |known: Option<String>| {
        let kept = Arc::new(Kept::default());
        cluster.beside((&spec, &kept, "f"), |job| Job { known, prefix: "jobs/2".into(), ..job }, |_, _| {})
    };
    assert!(again(None).unwrap_err().to_string().contains("upload the scene first"));
    cluster.runtime.block_on(cluster.stores[0].delete(&["out/a.exr".to_owned()])).unwrap();
    again(Some(scene.clone())).unwrap();
    assert!(cluster.picture(0) == expected(&spec));
    // another job that names it by its hash alone
    let mut named = spec.clone();
    (named.scene.source, named.scene.prepared, named.splits) = (String::new(), Some(scene.clone()), None);
    cluster.runtime.block_on(cluster.stores[0].delete(&["out/a.exr".to_owned()])).unwrap();
    let (kept, known) = (Arc::new(Kept::default()), Some(scene.clone()));
    cluster.beside((&named, &kept, "g"), |job| Job { known, prefix: "jobs/3".into(), ..job }, |_, _| {}).unwrap();
    assert!(kept.prepared.lock().unwrap()[0].1, "nothing was prepared");
    assert!(cluster.picture(0) == expected(&spec));
    // one file alone, of a job that is finished: nothing but that is done
    let rendered = kept.reports.lock().unwrap()[0].tasks;
    for (files, there, address) in
        [(PictureFile::Exr, (true, false), "out/a.exr"), (PictureFile::Png, (false, true), "out/a.png")]
    {
        cluster.runtime.block_on(cluster.stores[1].delete(&["out/a.exr".into(), "out/a.png".into()])).unwrap();
        named.image.files = Some(vec![files]);
        let known = Some(scene.clone());
        let session = address.rsplit_once('.').unwrap().1;
        cluster
            .beside((&named, &kept, session), |job| Job { known, prefix: "jobs/3".into(), ..job }, |_, _| {})
            .unwrap();
        let exr = cluster.runtime.block_on(cluster.stores[1].get("out/a.exr"));
        assert_eq!((exr.is_ok(), shown().is_ok()), there);
        let last = kept.reports.lock().unwrap().last().unwrap().clone();
        assert_eq!((last.tasks, last.tasks_reused), (0, rendered));
        assert!(kept.pictures.lock().unwrap().last().unwrap().iter().all(|at| at.ends_with(address)));
    }
    assert_eq!(shown().unwrap(), texels(&png));
    let absent = "0".repeat(64);
    named.scene.prepared = Some(absent.clone());
    let by_name = cluster.beside(
        (&named, &Arc::new(Kept::default()), "h"),
        |job| Job { known: Some(absent.clone()), prefix: "jobs/4".into(), ..job },
        |_, _| {},
    );
    let error = by_name.unwrap_err().to_string();
    assert!(error.contains("has no prepared scene 0000") && error.contains("status.scene"), "{error}");
}
