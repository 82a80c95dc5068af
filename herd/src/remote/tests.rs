//! Whole jobs over stores in memory: operator and workers in this process, the messages as they would go over the wire.

mod apart;
mod cached;
mod deaths;
mod lost;
mod previews;
mod versions;
mod whole;

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
use crate::job::{JobError, JobSettings, PICTURE, PreparedScene, Sampling, Silent, spec as from_spec};
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
    /// Those of them that were not reported yet, and whose they are.
    in_hand: Mutex<BTreeMap<String, WorkerId>>,
    /// The most that one worker had of them.
    at_once: Arc<AtomicU32>,
}

fn over<T: serde::Serialize + serde::de::DeserializeOwned>(message: &T) -> T {
    serde_json::from_str(&serde_json::to_string(message).unwrap()).unwrap()
}

impl Link for Wire<'_> {
    fn poll(&self, poll: &Poll) -> Result<Answer, LinkError> {
        self.polls.fetch_add(1, Ordering::Relaxed);
        let answer = self.runtime.block_on(self.fleet.poll(&over(poll), Duration::from_millis(200)));
        let answer = answer.map_err(|e| LinkError(e.to_string()))?;
        if let Answer::Work { id, work } = &answer
            && matches!(**work, super::Work::Attempt { .. })
        {
            self.attempts.fetch_add(1, Ordering::Relaxed);
            let mut in_hand = self.in_hand.lock().unwrap();
            in_hand.insert(id.clone(), poll.worker.clone());
            let of_this = in_hand.values().filter(|worker| **worker == poll.worker).count();
            self.at_once.fetch_max(of_this as u32, Ordering::Relaxed);
        }
        Ok(over(&answer))
    }
    fn report(&self, report: &Report) -> Result<(), LinkError> {
        self.in_hand.lock().unwrap().remove(&report.id);
        self.fleet.report(over(report)).map(drop).map_err(|e| LinkError(e.to_string()))
    }
    fn beat(&self, beat: &Beat) -> Result<Vec<String>, LinkError> {
        self.fleet.beat(&over(beat)).map_err(|e| LinkError(e.to_string()))
    }
}

/// A wire that somebody asks for work in another way.
struct Tap<'a, F>(Wire<'a>, F);

impl<'a, F: Fn(&Wire<'a>, &Poll) -> Result<Answer, LinkError> + Send + Sync> Link for Tap<'a, F> {
    fn poll(&self, poll: &Poll) -> Result<Answer, LinkError> {
        (self.1)(&self.0, poll)
    }
    fn report(&self, report: &Report) -> Result<(), LinkError> {
        self.0.report(report)
    }
    fn beat(&self, beat: &Beat) -> Result<Vec<String>, LinkError> {
        self.0.beat(beat)
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
    spec.sampling.seed = Some(7);
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
    let spp = from_spec::samples(spec, &scene.manifest);
    let sampling = Sampling { spp, target_error: spec.sampling.target_error, time_limit: None };
    let out = render_local(&scene, &frame, &sampling, &JobSettings::default(), &Silent).unwrap();
    let definition = from_spec::definition(&scene.manifest, &frame, &out.samples).unwrap();
    let layers = out.film.channels(&out.samples, scene.manifest.offset);
    let shown = png_file::encode(&out.image, spec.image.exposure.unwrap_or(0.0)).unwrap();
    (picture::encode(&out.image, &layers, &definition).unwrap(), shown, out.report)
}

struct Cluster {
    stores: Vec<Arc<Faulty>>,
    runtime: Runtime,
    scratch: tempfile::TempDir,
    turns: Turns,
    /// Of each worker.
    slots: u32,
    /// Most attempts that a worker had in hand at a time.
    at_once: Arc<AtomicU32>,
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
        let (scratch, turns, at_once) = (tempfile::tempdir().unwrap(), Turns::default(), Arc::default());
        let (slots, band, apart, profile) = (1, BAND, APART, false);
        let cluster = Cluster { stores, runtime, scratch, turns, slots, at_once, band, apart, profile };
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
            slots: vec![self.slots; 3],
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
        Station::new(link, self.depot(home), self.slots, worker, scratch).unwrap()
    }
    fn wire<'a>(&self, fleet: &'a Fleet) -> Wire<'a> {
        let (polls, attempts, in_hand, at_once) = (0.into(), 0.into(), Mutex::default(), self.at_once.clone());
        Wire { fleet, runtime: self.runtime.handle().clone(), polls, attempts, in_hand, at_once }
    }
    /// No source is known by its listing any more: workers are asked.
    fn forget_sources(&self) {
        for store in &self.stores {
            let names = self.runtime.block_on(store.list("names/source-")).unwrap();
            let names: Vec<String> = names.into_iter().map(|(key, _)| key).collect();
            self.runtime.block_on(store.delete(&names)).unwrap();
        }
    }
    /// All that lies below the job's prefix, on each store.
    fn lies(&self) -> Vec<Vec<String>> {
        let of = |store: &Arc<Faulty>| self.runtime.block_on(store.list("jobs/1/")).unwrap();
        self.stores.iter().map(|store| of(store).into_iter().map(|(key, _)| key).collect()).collect()
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
        tiles: true,
        picture: PICTURE,
        holds: None,
    }
}

/// The pod of a worker is known to be gone.
pub(super) fn gone(fleet: &Fleet, number: u32, session: &str) {
    fleet.only(|n, s| (n, s) != (number, session));
}

fn wait_for(what: impl Fn() -> bool) {
    let since = Instant::now();
    while !what() {
        assert!(since.elapsed() < Duration::from_secs(120), "waited in vain");
        std::thread::sleep(Duration::from_millis(2));
    }
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
