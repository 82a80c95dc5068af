//! Workers of earlier versions, and what they have begun.

use rayherd_render::film::Samples;

use super::*;
use crate::remote::Work;

/// A job that a version without bands has begun, whose film is stored as a whole, goes on by bands; and what it stores of its film does not
/// pile up.
#[test]
fn a_film_that_was_stored_in_other_parts_goes_on() {
    let mut spec = spec(Strategy::SchedulingGridOverlapReduced, 4, 2);
    spec.task_seconds = Some(0.003);
    let want = expected(&spec);
    let layout = Layout { size: [48, 40], aovs: Aovs::ALL };
    assert_eq!([1, 8, 11, BAND].map(|band| bands::tiles(band, layout)), [1, 2, 3, 139]);
    for (first, then, tiles) in [(BAND, 1, 1), (BAND, 11, 3), (BAND, BAND, 139)] {
        let (cluster, kept) = (Cluster { band: first, ..Cluster::new(3) }, Arc::new(Kept::default()));
        begun(&cluster, &spec, &kept, 30);
        let cluster = Cluster { band: then, ..cluster };
        if let Err(e) = cluster.render(&spec, &kept) {
            panic!("{first} {then}: {e}");
        }
        assert!(cluster.picture(1) == want, "{first} {then}");
        let reports = kept.reports.lock().unwrap();
        assert!(reports[0].tasks_reused > 0 && reports[0].tasks_redone == 0, "{:?}", reports[0]);
        let part = cluster.depot(None).part("jobs/1/0", 2).unwrap();
        let records = cluster.runtime.block_on(journal::read(&part)).unwrap();
        let bands: BTreeSet<Option<u32>> = records
            .values()
            .max_by_key(|r| r.sequence)
            .and_then(|r| Some(r.snapshot.as_ref()?.film.iter().map(|f| f.band).collect()))
            .expect("a job ends with a snapshot");
        let all = (0..4u32.div_ceil(tiles)).map(|b| (tiles < 4).then_some(b)).collect();
        assert_eq!(bands, all);
        // parts that were added up are deleted, all but those of the last snapshots and of the last state without rays on their way
        for store in &cluster.stores {
            let lie = cluster.runtime.block_on(store.list("jobs/1/0/film/")).unwrap().len() as u64;
            println!("{first} {then}: {lie} film objects, {} tasks", reports[0].tasks);
            assert!(lie * 3 < reports[0].tasks, "{lie} of {}", reports[0].tasks);
        }
    }
}

fn merge(band: Option<u32>, spp: Samples, tiles: bool) -> Work {
    Work::Merge { name: None, parts: vec![], spp, picture: None, band, tiles }
}

/// Workers of a version that has one number of samples for all tiles cannot read others, and tell no errors of tiles.
#[test]
fn a_worker_that_knows_no_samples_by_tile_is_given_none() {
    let fleet = Fleet::new(2, "e");
    let poll = |number: u32, tiles: bool| {
        let mut text = serde_json::to_value(poll(number, "a")).unwrap();
        if !tiles {
            // as it is written where the word is not known
            text.as_object_mut().unwrap().remove("tiles");
        }
        serde_json::from_value::<Poll>(text).unwrap()
    };
    let given = |number, tiles| match fleet.answer(&poll(number, tiles)).unwrap() {
        Answer::Work { work, .. } => Some(*work),
        _ => None,
    };
    let each = Samples::of(vec![16, 24]);
    let works = [merge(None, each, false), merge(None, 16.into(), true), merge(None, 16.into(), false)];
    assert!(!serde_json::to_string(&works[2]).unwrap().contains("tiles"), "as it always was");
    std::thread::scope(|scope| {
        let call = scope.spawn(|| fleet.call_all(works.to_vec()));
        let old = std::cell::OnceCell::new();
        wait_for(|| given(0, false).is_some_and(|work| old.set(work).is_ok()));
        assert_eq!(old.get(), Some(&works[2]));
        assert_eq!(
            (given(0, false), given(1, true), given(1, true)),
            (None, Some(works[0].clone()), Some(works[1].clone()))
        );
        fleet.cancel("enough");
        assert!(matches!(call.join().unwrap(), Err(JobError::Owned(_))));
    });
}

/// Workers of a version without bands would add the whole of a part to each band: as long as one is there, films are added up whole, and
/// it gets nothing else.
#[test]
fn a_worker_that_knows_no_bands_is_given_none() {
    let fleet = Fleet::new(2, "e");
    let poll = |number: u32, bands: bool| {
        let text = serde_json::to_value(Poll { bands, ..poll(number, "a") }).unwrap();
        // as it is written where the word is not known
        let serde_json::Value::Object(mut map) = text else { unreachable!() };
        if !bands {
            map.remove("bands");
        }
        serde_json::from_value::<Poll>(map.into()).unwrap()
    };
    assert!(fleet.knows_bands());
    let merge = |band| merge(band, 1.into(), false);
    let given = |number, bands| match fleet.answer(&poll(number, bands)).unwrap() {
        Answer::Work { work, .. } => Some(*work),
        _ => None,
    };
    std::thread::scope(|scope| {
        let call = scope.spawn(|| fleet.call_all(vec![merge(Some(0)), merge(None)]));
        let old = std::cell::OnceCell::new();
        wait_for(|| given(0, false).is_some_and(|work| old.set(work).is_ok()));
        assert_eq!(old.get(), Some(&merge(None)));
        assert!(!fleet.knows_bands());
        assert_eq!((given(0, false), given(1, true)), (None, Some(merge(Some(0)))));
        fleet.cancel("enough");
        assert!(matches!(call.join().unwrap(), Err(JobError::Owned(_))));
    });
}

/// A version of other formulas began a picture, here one of another seed: it is another picture, and nothing of it comes into this one.
#[test]
fn a_picture_that_a_version_of_other_formulas_began_is_rendered_anew() {
    let spec = spec(Strategy::SchedulingGridOverlapReduced, 4, 2);
    let mut other = spec.clone();
    other.sampling.seed = Some(spec.sampling.seed.unwrap_or(0) + 1);
    let (cluster, kept) = (Cluster::new(3), Arc::new(Kept::default()));
    begun(&cluster, &other, &kept, 4);
    let before = kept.newest(0).unwrap();
    // stopped before it has a record of its own, and after
    begun(&cluster, &spec, &kept, 0);
    let stopped = cluster.beside(
        (&spec, &kept, "e3"),
        |job| job,
        |fleet, is_over| {
            wait_for(|| {
                kept.newest(0).unwrap() != before && kept.newest(0).unwrap().is_some_and(|p| p.0 >= 2) || is_over()
            });
            fleet.cancel("stopped by the test");
        },
    );
    assert!(matches!(stopped, Err(JobError::Owned(_))), "{:?}", stopped.err());
    cluster.render(&spec, &kept).unwrap();
    assert!(cluster.picture(0) == expected(&spec));
}

/// It would leave the layers out without a word: of a job that asks for some it gets nothing, of another one its share. One that would make another
/// picture gets nothing of any.
#[test]
fn a_worker_that_knows_no_layers_or_makes_another_picture_gets_nothing_of_what_it_cannot_do() {
    for (word, layers, fits) in [("aovs", true, false), ("aovs", false, true), ("picture", false, false)] {
        let mut spec = spec(Strategy::SchedulingGridOverlapReduced, 4, 2);
        spec.image.aovs = spec.image.aovs.filter(|_| layers);
        let (cluster, kept) = (Cluster { band: 1, ..Cluster::new(3) }, Arc::new(Kept::default()));
        let (fleet, depot) = (Fleet::new(3, "e"), cluster.depot(None));
        let wire = cluster.wire(&fleet);
        let works = Mutex::new(Vec::new());
        // polls as a version writes them that does not know the word
        let old = Tap(cluster.wire(&fleet), |wire: &Wire, poll: &Poll| {
            let mut written = serde_json::to_value(poll).unwrap();
            assert!(written.as_object_mut().unwrap().remove(word).is_some());
            let answer = wire.poll(&serde_json::from_value(written).unwrap())?;
            if let Answer::Work { work, .. } = &answer {
                works.lock().unwrap().push((**work).clone());
            }
            Ok(answer)
        });
        std::thread::scope(|scope| {
            let aside = Station::new(
                &old,
                cluster.depot(Some(0)),
                1,
                WorkerId { number: 0, session: "s".into() },
                cluster.scratch.path().to_owned(),
            );
            scope.spawn(move || aside.unwrap().run().unwrap());
            for number in 1..3 {
                let station = cluster.station(&wire, number, "s", Some(number));
                scope.spawn(move || station.run().unwrap());
            }
            let keeper: Arc<dyn Keeper> = kept.clone();
            let result = run(&cluster.job(&spec, &depot, &fleet, "e"), &keeper, &Silent);
            assert_eq!(fleet.unfit(), if fits { vec![] } else { vec![0] });
            assert_eq!(fleet.is_up(0), fits);
            fleet.end();
            result.unwrap();
        });
        assert!(cluster.picture(1) == expected(&spec), "{word}, layers: {layers}");
        let works = works.lock().unwrap();
        // a scene is the same with and without
        let of_stage = works.iter().filter(|w| !matches!(w, Work::Prepare { .. })).count();
        assert_eq!(of_stage > 0, fits, "{works:?}");
    }
}
