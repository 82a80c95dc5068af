//! Whole jobs over stores in memory: operator and workers in this process, the messages as they would go over the wire.

mod apart;
mod cached;
mod previews;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, LazyLock, Mutex};
use std::time::{Duration, Instant};

use rayherd_api::{Aov, PictureFile, RenderJobSpec, Strategy};
use rayherd_render::aov::Aovs;
use rayherd_render::film::Layout;
use rayherd_render::skip::Skip;
use rayherd_scene::import::{DescriptionSource, StreamOptions, import};
use rayherd_scene::manifest::Manifest;
use rayherd_scene::objects::{MemoryObjects, ObjectRef};
use rayherd_scene::prepare::{NoProgress, SpoolSettings, prepare};
use tokio::runtime::{Handle, Runtime};

use super::bands::{self, BAND};
use super::frames::{Job, Keeper, run};
use super::message::{Answer, Beat, Poll, Report, WorkerId};
use super::preparing::APART;
use super::{Depot, Fleet, Link, LinkError, Station, Turns};
use crate::driver::{Event, Executor};
use crate::job::{JobError, JobSettings, PreparedScene, Sampling, Silent, spec as from_spec};
use crate::local::{journal, render_local};
use crate::profile::Part;
use crate::report;
use crate::store::{BlockStore, FaultPlan, Faulty, MemoryStore, Patience, SceneObjects, Watched, object_key};
use crate::{picture, png_file, scenes};

const EXAMPLE: &str = include_str!("../../../examples/cornell-box.xml");
const SOURCE: &str = "scenes/cornell/box.xml";
const TEXTURE: &str = "scenes/cornell/wall.hdr";

/// The example, with a picture on its red wall.
static CORNELL: LazyLock<String> = LazyLock::new(|| {
    let red = EXAMPLE.find("id=\"red\"").unwrap();
    let from = red + EXAMPLE[red..].find("<rgb").unwrap();
    let to = from + EXAMPLE[from..].find("/>").unwrap() + 2;
    let texture =
        "<texture type=\"bitmap\" name=\"reflectance\"><string name=\"filename\" value=\"wall.hdr\"/></texture>";
    format!("{}{texture}{}", &EXAMPLE[..from], &EXAMPLE[to..])
});

/// 150 x 130 texels: four tiles.
fn wall() -> Vec<u8> {
    let head = "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 130 +X 150\n";
    // no row begins as one of runs does
    let texels = (0..130 * 150u32).flat_map(|i| [200, (i % 97) as u8, (i % 61) as u8, 128]);
    head.bytes().chain(texels).collect()
}

/// Messages as text, as over the wire.
struct Wire<'a> {
    fleet: &'a Fleet,
    runtime: Handle,
    polls: AtomicU32,
    /// Attempts that were handed out before this stops being an operator.
    attempts: AtomicU32,
}

fn over<T: serde::Serialize + serde::de::DeserializeOwned>(message: &T) -> T {
    serde_json::from_str(&serde_json::to_string(message).unwrap()).unwrap()
}

impl Link for Wire<'_> {
    fn poll(&self, poll: &Poll) -> Result<Answer, LinkError> {
        self.polls.fetch_add(1, Ordering::Relaxed);
        let answer = self.runtime.block_on(self.fleet.poll(&over(poll), Duration::from_millis(200)));
        let answer = answer.map_err(|e| LinkError(e.to_string()))?;
        if matches!(&answer, Answer::Work { work, .. } if matches!(**work, super::Work::Attempt { .. })) {
            self.attempts.fetch_add(1, Ordering::Relaxed);
        }
        Ok(over(&answer))
    }
    fn report(&self, report: &Report) -> Result<(), LinkError> {
        self.fleet.report(over(report)).map(drop).map_err(|e| LinkError(e.to_string()))
    }
    fn beat(&self, beat: &Beat) -> Result<Vec<String>, LinkError> {
        self.fleet.beat(&over(beat)).map_err(|e| LinkError(e.to_string()))
    }
}

/// What etcd would keep.
#[derive(Default)]
struct Kept {
    pointers: Mutex<BTreeMap<u32, (u64, String)>>,
    prepared: Mutex<Vec<(ObjectRef, bool)>>,
    reports: Mutex<Vec<report::Report>>,
    pictures: Mutex<Vec<Vec<String>>>,
    below: Mutex<Vec<Option<String>>>,
}

impl Keeper for Kept {
    fn newest(&self, frame: u32) -> Result<Option<(u64, String)>, JobError> {
        Ok(self.pointers.lock().unwrap().get(&frame).cloned())
    }
    fn move_to(&self, frame: u32, sequence: u64, name: &str) -> Result<(), JobError> {
        let old = self.pointers.lock().unwrap().insert(frame, (sequence, name.to_owned()));
        assert!(
            old.is_none_or(|o| o.0 + 1 >= sequence),
            "the pointer moves by one record, or back to what can be read"
        );
        Ok(())
    }
    fn prepared(&self, scene: &ObjectRef, reused: bool) {
        self.prepared.lock().unwrap().push((*scene, reused));
    }
    fn placed(&self, bytes: &[u64]) {
        assert!(bytes.iter().sum::<u64>() > 0);
    }
    fn below(&self, what: Option<&str>) {
        self.below.lock().unwrap().push(what.map(str::to_owned));
    }
    fn done(&self, _: u32, picture: &[String], report: &report::Report) {
        self.pictures.lock().unwrap().push(picture.to_vec());
        self.reports.lock().unwrap().push(report.clone());
    }
}

fn spec(strategy: Strategy, splits: i64, replicas: i32) -> RenderJobSpec {
    let mut spec =
        RenderJobSpec { strategy, splits: Some(splits), replicas: Some(replicas), ..RenderJobSpec::default() };
    spec.scene.source = SOURCE.into();
    spec.image.size = Some("48x40".parse().unwrap());
    // of some jobs the picture has layers
    spec.image.aovs = (replicas == 2).then(|| Aov::ALL.to_vec());
    spec.sampling.spp = Some(6);
    spec.sampling.max_depth = Some(5);
    spec.task_seconds = Some(0.01);
    spec
}

/// The file that a local run would write.
fn expected(spec: &RenderJobSpec) -> Vec<u8> {
    local(spec).0
}

/// Texels of a PNG.
fn texels(file: &[u8]) -> Vec<u8> {
    let mut reader = png::Decoder::new(std::io::Cursor::new(file)).read_info().unwrap();
    let mut texels = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut texels).unwrap();
    texels
}

/// That file and the report of that run.
fn local(spec: &RenderJobSpec) -> (Vec<u8>, report::Report) {
    let (exr, _, report) = local_files(spec);
    (exr, report)
}

/// Both files of a local run, and its report.
fn local_files(spec: &RenderJobSpec) -> (Vec<u8>, Vec<u8>, report::Report) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("box.xml");
    std::fs::write(&path, CORNELL.as_str()).unwrap();
    std::fs::write(folder.path().join("wall.hdr"), wall()).unwrap();
    let description = import(&path, &from_spec::import_options(spec)).unwrap();
    let source = DescriptionSource::new(&description, StreamOptions::default());
    let objects = Arc::new(MemoryObjects::default());
    let settings = from_spec::prepare_settings(spec);
    let made = prepare(&description, &source, &settings, &SpoolSettings::default(), objects.as_ref(), &NoProgress);
    let scene = PreparedScene::open(made.unwrap().manifest, objects).unwrap();
    let frame = from_spec::frame(spec, &scene.manifest, None).unwrap();
    let sampling = Sampling { spp: 6, target_error: None, time_limit: None };
    let out = render_local(&scene, &frame, &sampling, &JobSettings::default(), &Silent).unwrap();
    let definition = from_spec::definition(&scene.manifest, &frame, out.spp).unwrap();
    let layers = out.film.channels(out.spp, scene.manifest.offset);
    let shown = png_file::encode(&out.image, spec.image.exposure.unwrap_or(0.0)).unwrap();
    (picture::encode(&out.image, &layers, &definition).unwrap(), shown, out.report)
}

struct Cluster {
    stores: Vec<Arc<Faulty>>,
    runtime: Runtime,
    scratch: tempfile::TempDir,
    turns: Turns,
    /// Tiles of a band, of four that the film has, without AOVs: with all of them it takes 11 for 3.
    band: u32,
    /// Primitives from which on all workers build a scene.
    apart: u64,
    /// Whether the reports say what the stages of attempts cost.
    profile: bool,
}

impl Cluster {
    fn new(nodes: usize) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
        let memory = || Arc::new(Faulty::new(Arc::new(MemoryStore::default()), FaultPlan::default()));
        let stores = (0..nodes).map(|_| memory()).collect();
        let (scratch, turns) = (tempfile::tempdir().unwrap(), Turns::default());
        let cluster = Cluster { stores, runtime, scratch, turns, band: BAND, apart: APART, profile: false };
        cluster.runtime.block_on(cluster.stores[0].put(SOURCE, CORNELL.clone().into())).unwrap();
        cluster.runtime.block_on(cluster.stores[0].put(TEXTURE, wall().into())).unwrap();
        cluster
    }
    fn depot(&self, home: Option<u32>) -> Depot {
        depot(&self.stores, home)
    }
    fn job<'a>(&'a self, spec: &'a RenderJobSpec, depot: &'a Depot, fleet: &'a Fleet, session: &str) -> Job<'a> {
        Job {
            spec,
            pictures: vec!["out/a.exr".into()],
            known: None,
            patience: Duration::from_millis(300),
            prefix: "jobs/1".into(),
            session: session.into(),
            depot,
            fleet,
            turns: &self.turns,
            slots: vec![1; 3],
            band: self.band,
            apart: self.apart,
            profile: self.profile,
            runtime: self.runtime.handle().clone(),
        }
    }
    fn station<'l>(&self, link: &'l Wire<'l>, number: u32, session: &str, home: Option<u32>) -> Station<'l> {
        // the same path for all workers, as in their pods: it is part of a source's fingerprint
        let scratch = self.scratch.path().to_owned();
        let worker = WorkerId { number, session: session.into() };
        Station::new(link, self.depot(home), 1, worker, scratch).unwrap()
    }
    fn wire<'a>(&self, fleet: &'a Fleet) -> Wire<'a> {
        Wire { fleet, runtime: self.runtime.handle().clone(), polls: AtomicU32::new(0), attempts: AtomicU32::new(0) }
    }
    /// No source is known by its listing any more: workers are asked.
    fn forget_sources(&self) {
        for store in &self.stores {
            let names = self.runtime.block_on(store.list("names/source-")).unwrap();
            let names: Vec<String> = names.into_iter().map(|(key, _)| key).collect();
            self.runtime.block_on(store.delete(&names)).unwrap();
        }
    }
    fn picture(&self, store: usize) -> Vec<u8> {
        self.runtime.block_on(self.stores[store].get("out/a.exr")).unwrap().to_vec()
    }
    /// A whole job with three workers, one of them on a node without a store.
    fn render(&self, spec: &RenderJobSpec, kept: &Arc<Kept>) -> Result<(), JobError> {
        let (fleet, depot) = (Fleet::new(3, "e"), self.depot(None));
        let wire = self.wire(&fleet);
        std::thread::scope(|scope| {
            for number in 0..3 {
                let home = (number < 2).then_some(number);
                let station = self.station(&wire, number, "s", home);
                scope.spawn(move || station.run().unwrap());
            }
            let keeper: Arc<dyn Keeper> = kept.clone();
            let result = run(&self.job(spec, &depot, &fleet, "e"), &keeper, &Silent);
            fleet.end();
            result
        })
    }

    /// A job with a worker beside each of three stores, while something happens: it is given the fleet and whether the job is over.
    fn beside(
        &self,
        (spec, kept, session): (&RenderJobSpec, &Arc<Kept>, &str),
        change: impl for<'a> FnOnce(Job<'a>) -> Job<'a> + Send,
        meanwhile: impl FnOnce(&Fleet, &dyn Fn() -> bool),
    ) -> Result<(), JobError> {
        let (fleet, depot) = (Fleet::new(3, session), self.depot(None));
        let wire = self.wire(&fleet);
        std::thread::scope(|scope| {
            for number in 0..3 {
                let station = self.station(&wire, number, session, Some(number));
                scope.spawn(move || station.run().unwrap());
            }
            let keeper: Arc<dyn Keeper> = kept.clone();
            let (fleet, depot) = (&fleet, &depot);
            let job = scope.spawn(move || {
                let result = run(&change(self.job(spec, depot, fleet, session)), &keeper, &Silent);
                fleet.end();
                result
            });
            meanwhile(fleet, &|| job.is_finished());
            job.join().unwrap()
        })
    }
}

fn depot(stores: &[Arc<Faulty>], home: Option<u32>) -> Depot {
    let patience = Patience { answer: Duration::from_millis(200), pause: Duration::from_millis(300) };
    let watched = |s: &Arc<Faulty>| Arc::new(Watched::new(s.clone(), s.clone(), patience));
    Depot::watched(stores.iter().map(watched).collect(), home).unwrap()
}

/// A worker of this version on a node without a store asks for work, no stage open.
pub(super) fn poll(number: u32, session: &str) -> Poll {
    Poll {
        worker: WorkerId { number, session: session.into() },
        home: None,
        stage: None,
        clerk: false,
        bands: true,
        aovs: true,
        builds: true,
        previews: true,
        holds: None,
    }
}

fn wait_for(what: impl Fn() -> bool) {
    let since = Instant::now();
    while !what() {
        assert!(since.elapsed() < Duration::from_secs(120), "waited in vain");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn every_strategy_makes_the_bytes_of_a_local_run() {
    for (strategy, splits, memory, band, layers) in [
        (Strategy::Auto, 1, None, BAND, true),
        (Strategy::Auto, 6, Some("64Ki"), 1, false),
        (Strategy::DemandDriven, 4, None, 11, true),
        (Strategy::SchedulingGrid, 4, None, 1, true),
        (Strategy::SchedulingGridOverlapReduced, 4, None, BAND, false),
        (Strategy::SchedulingGridOverlapReduced, 4, None, 2, false),
    ] {
        let mut spec = spec(strategy, splits, 2);
        spec.image.aovs = spec.image.aovs.filter(|_| layers);
        spec.workers.memory = memory.map(|m: &str| m.parse().unwrap());
        let profile = splits > 1;
        let (cluster, kept) = (Cluster { band, profile, ..Cluster::new(2) }, Arc::new(Kept::default()));
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
        assert_eq!(kept.pictures.lock().unwrap()[0].len(), 2);
        // what workers spent, of those of committed attempts, comes with their results
        let costs = reports[0].profile.map(|p| [Part::Shading, Part::Shadow].map(|part| p.of(part).items));
        assert_eq!(costs.is_some(), profile, "{strategy}");
        assert!(costs.is_none_or(|c| c[0] == reports[0].rays.closest && c[1] >= reports[0].rays.shadow), "{strategy}");
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
        let gone = poll.worker.clone();
        wait_for(|| matches!(first.answer(&poll), Ok(Answer::Work { .. })));
        first.gone(&gone);
        cluster.render(spec, &kept).unwrap();
        first.cancel("enough");
        assert!(matches!(waits.join().unwrap(), Err(JobError::Owned(_))));
    });
    assert!(cluster.picture(0) == expected(spec));
}

#[test]
fn workers_and_operators_that_go_change_no_byte() {
    let spec = spec(Strategy::SchedulingGridOverlapReduced, 4, 2);
    let want = expected(&spec);
    let (cluster, kept) = (Cluster::new(3), Arc::new(Kept::default()));
    let depot = cluster.depot(None);
    // the operator is stopped after some commits, and a worker with a task in hand leaves before
    let first = Fleet::new(3, "e1");
    let wire = cluster.wire(&first);
    std::thread::scope(|scope| {
        let stations: Vec<Arc<Station>> = (0..3).map(|n| Arc::new(cluster.station(&wire, n, "s1", Some(n)))).collect();
        for station in &stations {
            let station = station.clone();
            scope.spawn(move || station.run().unwrap());
        }
        let keeper: Arc<dyn Keeper> = kept.clone();
        let (spec, depot, first, cluster, kept) = (&spec, &depot, &first, &cluster, &kept);
        let job = scope.spawn(move || run(&cluster.job(spec, depot, first, "e1"), &keeper, &Silent));
        wait_for(|| wire.attempts.load(Ordering::Relaxed) >= 4);
        stations[1].leave();
        wait_for(|| kept.newest(0).unwrap().is_some_and(|p| p.0 >= 6));
        first.cancel("stopped by the test");
        let stopped = job.join().unwrap();
        assert!(matches!(stopped, Err(JobError::Owned(_))), "{:?}", stopped.err());
        first.end();
    });
    let committed = kept.newest(0).unwrap().unwrap().0;
    assert!(committed >= 6);
    // a record that was written beyond the pointer does not count
    cluster.beside((&spec, &kept, "e2"), |job| job, |_, _| {}).unwrap();
    assert!(cluster.picture(2) == want);
    assert!(kept.reports.lock().unwrap()[0].tasks_reused > 0);
}

/// Runs a job until so many records count, then stops its operator.
fn begun(cluster: &Cluster, spec: &RenderJobSpec, kept: &Arc<Kept>, records: u64) {
    let stopped = cluster.beside(
        (spec, kept, "e1"),
        |job| job,
        |fleet, is_over| {
            wait_for(|| kept.newest(0).unwrap().is_some_and(|p| p.0 >= records) || is_over());
            fleet.cancel("stopped by the test");
        },
    );
    assert!(matches!(stopped, Err(JobError::Owned(_))), "{:?}", stopped.err());
}

#[test]
fn an_unreadable_record_or_snapshot_costs_work_and_not_the_job() {
    let mut spec = spec(Strategy::SchedulingGridOverlapReduced, 4, 2);
    spec.sampling.spp = Some(6);
    spec.task_seconds = Some(0.003);
    let want = expected(&spec);
    let its_film = "the newest snapshot's film";
    for (broken, band) in
        [("the pointer's record", BAND), ("the newest snapshot", 1), (its_film, BAND), (its_film, 1), ("all film", 1)]
    {
        let (cluster, kept) = (Cluster { band, ..Cluster::new(3) }, Arc::new(Kept::default()));
        begun(&cluster, &spec, &kept, 40);
        let part = cluster.depot(None).part("jobs/1/0", 2).unwrap();
        let (sequence, name) = kept.newest(0).unwrap().unwrap();
        let mut records = cluster.runtime.block_on(journal::read(&part)).unwrap();
        records.retain(|n, r| r.sequence < sequence || *n == name);
        let snapshots = records.iter().filter(|r| r.1.snapshot.is_some());
        let (snapshot, record) = snapshots.max_by_key(|r| r.1.sequence).expect("there are snapshots");
        let film = record.snapshot.as_ref().and_then(|s| s.film.first()).map(|f| f.key.as_str());
        let wrong = match broken {
            "the pointer's record" => name.as_str(),
            "the newest snapshot" => snapshot.as_str(),
            "the newest snapshot's film" => film.expect("a snapshot with film"),
            _ => "film/",
        };
        let mut damaged = 0;
        for store in &cluster.stores {
            for (key, _) in cluster.runtime.block_on(store.list("jobs/1/0/")).unwrap() {
                if key.contains(wrong) {
                    cluster.runtime.block_on(store.damage(&key)).unwrap();
                    damaged += 1;
                }
            }
        }
        assert!(damaged > 0, "{broken}");
        if let Err(e) = cluster.render(&spec, &kept) {
            panic!("{broken}: {e}");
        }
        assert!(cluster.picture(1) == want, "{broken}");
        let reports = kept.reports.lock().unwrap();
        // a part of a band may be named by the snapshot before as well: then there is nothing to go on from
        let shared = broken == its_film && band == 1;
        assert!(shared || (reports[0].tasks_reused > 0) == (broken != "all film"), "{broken}: {:?}", reports[0]);
    }
}

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

#[test]
fn a_worker_that_comes_back_under_another_session_loses_only_its_tasks() {
    let fleet = Fleet::new(1, "e");
    let poll = |session: &str| poll(0, session);
    assert_eq!(fleet.answer(&poll("a")), Ok(Answer::Wait));
    assert!(fleet.answer(&super::tests::poll(1, "a")).is_err());
    std::thread::scope(|scope| {
        let work = super::Work::Merge { name: None, parts: vec![], spp: 1, picture: None, band: None };
        let call = scope.spawn(|| fleet.call(work));
        let handed = |session: &str| {
            let since = Instant::now();
            loop {
                match fleet.answer(&poll(session)).unwrap() {
                    Answer::Work { id, .. } => return id,
                    _ => assert!(since.elapsed() < Duration::from_secs(60)),
                }
                std::thread::sleep(Duration::from_millis(1));
            }
        };
        let first = handed("a");
        let second = handed("b");
        assert_ne!(first, second);
        let report = |session: &str, id: &str, rel_mse| Report {
            worker: WorkerId { number: 0, session: session.into() },
            id: id.into(),
            result: Ok(super::message::Done::Merged {
                film: None,
                rel_mse,
                error: None,
                non_finite: vec![],
                picture: vec![],
            }),
            cpu: 0.5,
            bytes: vec![],
            reads: Default::default(),
            holds: None,
            cache_failures: 0,
            resident: 5,
        };
        assert_eq!(fleet.report(report("b", &first, Some(1.0))), Ok(false), "its id is known no more");
        assert_eq!(fleet.report(report("b", "other-0", Some(2.0))), Ok(false));
        let beat = Beat { worker: poll("b").worker, running: vec![first.clone(), second.clone()] };
        assert_eq!(fleet.beat(&beat), Ok(vec![first]));
        assert_eq!((fleet.tally().running, fleet.tally().queued), (1, 0));
        assert_eq!(fleet.report(report("b", &second, Some(3.0))), Ok(true));
        assert_eq!(fleet.report(report("b", &second, Some(4.0))), Ok(false), "a replay");
        let tally = fleet.tally();
        assert_eq!(tally.by_worker.get(&0), Some(&super::fleet::WorkerTally { cpu: 0.5, resident: 5 }), "counted once");
        assert_eq!((tally.cpu, tally.running, tally.queued), (0.5, 0, 0));
        let done = call.join().unwrap().unwrap();
        assert!(matches!(done, super::message::Done::Merged { rel_mse: Some(x), .. } if x == 3.0));
    });
    assert_eq!(fleet.tally().outcomes, Default::default(), "there was no attempt");
    // the loop over rounds learns that the one that came back holds nothing
    let told = fleet.next(Duration::ZERO).unwrap();
    assert!(matches!(told, Some(Event::MemoryLost(0))) && fleet.next(Duration::ZERO).unwrap().is_none());
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
    let merge = |band| super::Work::Merge { name: None, parts: vec![], spp: 1, picture: None, band };
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

/// A worker of a version without AOVs, as its polls are written where the word is not known.
struct Old<'a>(&'a Wire<'a>, Mutex<Vec<super::Work>>);

impl Link for Old<'_> {
    fn poll(&self, poll: &Poll) -> Result<Answer, LinkError> {
        let mut written = serde_json::to_value(poll).unwrap();
        assert!(written.as_object_mut().unwrap().remove("aovs").is_some());
        let answer = self.0.poll(&serde_json::from_value(written).unwrap())?;
        if let Answer::Work { work, .. } = &answer {
            self.1.lock().unwrap().push((**work).clone());
        }
        Ok(answer)
    }
    fn report(&self, report: &Report) -> Result<(), LinkError> {
        self.0.report(report)
    }
    fn beat(&self, beat: &Beat) -> Result<Vec<String>, LinkError> {
        self.0.beat(beat)
    }
}

/// It would leave the layers out without a word: of a job that asks for some it gets nothing, of another one its share.
#[test]
fn a_worker_that_knows_no_layers_works_only_for_jobs_without() {
    for layers in [true, false] {
        let mut spec = spec(Strategy::SchedulingGridOverlapReduced, 4, 2);
        spec.image.aovs = spec.image.aovs.filter(|_| layers);
        let (cluster, kept) = (Cluster { band: 1, ..Cluster::new(3) }, Arc::new(Kept::default()));
        let (fleet, depot) = (Fleet::new(3, "e"), cluster.depot(None));
        let wire = cluster.wire(&fleet);
        let old = Old(&wire, Mutex::default());
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
            assert_eq!(fleet.unfit(), if layers { vec![0] } else { vec![] });
            assert_eq!(fleet.is_up(0), !layers);
            fleet.end();
            result.unwrap();
        });
        assert!(cluster.picture(1) == expected(&spec), "layers: {layers}");
        let works = old.1.into_inner().unwrap();
        // a scene is the same with and without
        let of_stage = works.iter().filter(|w| !matches!(w, super::Work::Prepare { .. })).count();
        assert_eq!(of_stage == 0, layers, "{works:?}");
    }
}

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

#[test]
fn workers_that_wait_are_sent_to_the_next_fleet_at_once() {
    let runtime = Runtime::new().unwrap();
    let fleet = Fleet::new(1, "e");
    let poll = poll(0, "a");
    // far longer than a test may take
    let waits = runtime.block_on(async {
        let waiting = fleet.poll(&poll, Duration::from_secs(3600));
        let retire = async {
            tokio::time::sleep(Duration::from_millis(20)).await;
            fleet.retire();
        };
        futures::future::join(waiting, retire).await.0
    });
    assert_eq!(waits, Ok(Answer::Wait));
}

/// A worker that is no station: it takes work, and does none of it.
struct Hand<'f>(&'f Fleet, &'f dyn Fn() -> bool);

impl Hand<'_> {
    /// A process of worker 0 takes work, after what stages it is told to open; the memory of the last of these.
    fn takes(&self, session: &str) -> (Option<u64>, super::Work) {
        let (mut stage, mut memory) = (None, None);
        let since = Instant::now();
        loop {
            let poll = Poll { stage: stage.clone(), ..poll(0, session) };
            match self.0.answer(&poll).unwrap() {
                Answer::Open { stage: now } => (memory, stage) = now.map_or((None, None), |s| (s.memory, Some(s.id))),
                Answer::Work { work, .. } => return (memory, *work),
                Answer::Wait => std::thread::sleep(Duration::from_millis(2)),
                Answer::Over => panic!("it is over"),
            }
            assert!(!(self.1)() && since.elapsed() < Duration::from_secs(60), "no work came");
        }
    }
}

/// Runs a job of one worker whose processes are the test's; what came of it.
fn by_hand(
    cluster: &Cluster,
    spec: &RenderJobSpec,
    known: Option<String>,
    kept: &Arc<Kept>,
    hand: impl FnOnce(&Hand, &Wire, &dyn Fn() -> bool),
) -> Result<(), JobError> {
    let (fleet, depot) = (Fleet::new(1, "h"), cluster.depot(None));
    let wire = cluster.wire(&fleet);
    std::thread::scope(|scope| {
        let keeper: Arc<dyn Keeper> = kept.clone();
        let (fleet, depot) = (&fleet, &depot);
        let job = scope.spawn(move || {
            let job = Job { known, slots: vec![1], prefix: "jobs/2".into(), ..cluster.job(spec, depot, fleet, "h") };
            let result = run(&job, &keeper, &Silent);
            fleet.end();
            result
        });
        let over = || job.is_finished();
        hand(&Hand(fleet, &over), &wire, &over);
        job.join().unwrap()
    })
}

#[test]
fn a_task_that_was_killed_for_lack_of_memory_holds_half_and_then_the_job_fails_with_the_sizes() {
    // one worker, and two copies on as many servers
    let mut spec = spec(Strategy::Auto, 6, 2);
    spec.workers.memory = Some("256Ki".parse().unwrap());
    let (cluster, kept) = (Cluster::new(2), Arc::new(Kept::default()));
    cluster.render(&spec, &kept).unwrap();
    let scene = kept.prepared.lock().unwrap()[0].0.hash.to_string();
    for deaths in [2, 3] {
        let kept = Arc::new(Kept::default());
        let done = by_hand(&cluster, &spec, Some(scene.clone()), &kept, |hand, wire, over| {
            let mut memories = Vec::new();
            for session in 0..deaths {
                let (memory, work) = hand.takes(&format!("s{session}"));
                assert!(matches!(work, super::Work::Attempt { .. }));
                memories.push(memory.unwrap());
                hand.0.killed_for_memory(0, Some("200Mi"));
            }
            assert_eq!(memories, [256 << 10, 128 << 10, 64 << 10][..deaths]);
            if deaths == 2 {
                let station = cluster.station(wire, 0, "at last", Some(0));
                std::thread::scope(|scope| {
                    scope.spawn(|| station.run().unwrap());
                    wait_for(over);
                });
            }
        });
        if deaths == 2 {
            done.unwrap();
            assert!(cluster.picture(0) == expected(&spec), "the memory changes no byte");
        } else {
            let said = done.unwrap_err().to_string();
            for part in [
                "256Ki, then 128Ki, then 64Ki of the scene",
                "may take 200Mi",
                "the largest split takes",
                "limits.memory",
            ] {
                assert!(said.contains(part), "{part}: {said}");
            }
        }
    }
}

#[test]
fn work_that_kills_its_worker_each_time_fails_the_job() {
    let spec = spec(Strategy::Auto, 4, 1);
    let (cluster, kept) = (Cluster::new(2), Arc::new(Kept::default()));
    // whoever prepares needs more memory than there is
    let done = by_hand(&cluster, &spec, None, &kept, |hand, _, _| {
        for session in 0..3 {
            let (_, work) = hand.takes(&format!("s{session}"));
            assert!(matches!(work, super::Work::Prepare { .. }));
            hand.0.killed_for_memory(0, Some("1Gi"));
        }
    });
    let said = done.unwrap_err().to_string();
    assert!(said.contains("preparing the scene: 3 workers were killed") && said.contains("may take 1Gi"), "{said}");
    // whatever they die of
    cluster.render(&spec, &kept).unwrap();
    cluster.forget_sources();
    let scene = kept.prepared.lock().unwrap()[0].0.hash.to_string();
    for known in [None, Some(scene)] {
        let what = if known.is_some() { "camera rays of tile" } else { "preparing the scene" };
        let kept = Arc::new(Kept::default());
        let done = by_hand(&cluster, &spec, known, &kept, |hand, _, over| {
            for session in 0..5 {
                hand.takes(&format!("s{session}"));
            }
            // the next process finds that the last one died as well
            let worker = WorkerId { number: 0, session: "last".into() };
            let beat = Beat { worker, running: vec![] };
            hand.0.beat(&beat).unwrap();
            wait_for(over);
        });
        let said = done.unwrap_err().to_string();
        assert!(said.contains(what) && said.contains("5 times the worker that had it in hand died"), "{said}");
    }
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
