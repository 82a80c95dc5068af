use std::collections::{BTreeMap, BTreeSet};
use std::num::NonZeroU32;
use std::sync::{Arc, LazyLock};

use rayherd_render::bvh::{Kernel, Tracer};

use super::*;
use crate::job::{Commits, NodeSpec, Progress, Silent};
use crate::plan::Strategy;
use crate::store::{BlockStore, MemoryStore};
use crate::testing;

fn sampling(spp: u32) -> Sampling {
    Sampling { spp, target_error: None, time_limit: None }
}

fn nodes(slots: &[u32]) -> Vec<NodeSpec> {
    slots.iter().map(|&slots| NodeSpec { slots }).collect()
}

/// The test scene, cut in several ways; the first one is whole.
static SCENES: LazyLock<Vec<PreparedScene>> = LazyLock::new(|| {
    let cuts = [(1, true), (4, true), (9, true), (4, false), (9, false)];
    cuts.map(|(splits, reduced)| testing::prepared(&testing::cornell(), splits, reduced)).into()
});

fn frame() -> Frame {
    testing::frame(&SCENES[0], [40, 24], 2)
}

/// A smaller one, for tests that render many times.
fn small_frame() -> Frame {
    testing::frame(&SCENES[0], [14, 10], 2)
}

/// The picture by samples, made once by a plain run.
fn expected(spp: u32) -> Arc<FilmPart> {
    static MADE: LazyLock<std::sync::Mutex<BTreeMap<u32, Arc<FilmPart>>>> = LazyLock::new(Default::default);
    let mut made = MADE.lock().unwrap();
    made.entry(spp)
        .or_insert_with(|| {
            let settings = JobSettings { kernel: Kernel::Scalar, ..JobSettings::default() };
            let out = render_local(&SCENES[0], &frame(), &sampling(spp), &settings, &Silent).unwrap();
            assert!(out.image.pixels.iter().flatten().sum::<f32>() > 10.0);
            Arc::new(out.film)
        })
        .clone()
}

pub(super) fn largest(scene: &PreparedScene) -> u64 {
    scene.grid.owning().iter().map(|s| scene.split_bytes(s)).max().unwrap()
}

/// Small tasks, so that there are many.
pub(super) fn small(strategy: Strategy, slots: &[u32]) -> JobSettings {
    JobSettings {
        strategy,
        nodes: nodes(slots),
        replicas: slots.len().min(2) as u32,
        task_seconds: 0.01,
        batch: 300,
        ray_buffer: 1 << 16,
        ..JobSettings::default()
    }
}

fn kernels() -> Vec<Kernel> {
    let all = [Kernel::Scalar, Kernel::Avx2, Kernel::Avx512, Kernel::Auto];
    all.into_iter().filter(|&k| Tracer::new(k).is_ok()).collect()
}

#[test]
fn every_strategy_makes_the_same_bytes() {
    let expected = expected(5);
    let kernels = kernels();
    // what each strategy met, by its number, and which settings met each other
    let mut met = BTreeSet::new();
    for (s, scene) in SCENES.iter().enumerate() {
        for (t, strategy) in Strategy::ALL.into_iter().enumerate() {
            for (several, slots) in [&[1][..], &[2, 1, 1]].into_iter().enumerate() {
                // each goes round in its own way, so that none hides behind another
                let batch = [1 << 14, 300, 37][(s + t + several) % 3];
                let threads = 1 + (2 * s + several) as u32 % 3;
                let barrier = [None, Some(true), Some(false)][(s + 2 * t) % 3];
                let kernel = kernels[(s + t + 2 * several) % kernels.len()];
                let memory = [2 * largest(scene), 3 * largest(scene), 1 << 30][(2 * s + 2 * several + t) % 3];
                let replicas = if several == 0 { 1 } else { 1 + (s + t) as u32 % 3 };
                let settings = JobSettings {
                    memory_per_node: Some(memory),
                    batch,
                    kernel,
                    threads: NonZeroU32::new(threads),
                    barrier,
                    replicas,
                    ..small(strategy, slots)
                };
                let name = |x: &dyn std::fmt::Debug| format!("{x:?}");
                met.extend([
                    (name(&strategy), "kernels", name(&kernel)),
                    (name(&strategy), "batches", name(&batch)),
                    (name(&strategy), "threads", name(&threads)),
                    (name(&strategy), "barriers", name(&barrier)),
                    (name(&strategy), "memories", name(&(memory / largest(scene)).min(4))),
                    (name(&strategy), "replicas", name(&replicas)),
                    (name(&batch), "threads", name(&threads)),
                    (name(&batch), "barriers", name(&barrier)),
                    (name(&barrier), "threads", name(&threads)),
                ]);
                let made = render_local(scene, &frame(), &sampling(5), &settings, &Silent);
                let made = made.unwrap_or_else(|e| panic!("{settings:?}: {e}"));
                assert!(made.film == *expected, "{settings:?} on {} splits", scene.splits());
                assert_eq!(made.report.spp, 5);
                assert!(
                    made.report.nodes_detail.iter().all(|d| d.peak_scene_bytes <= settings.memory_per_node.unwrap())
                );
            }
        }
    }
    let mut counts: BTreeMap<(&str, &str), usize> = BTreeMap::new();
    met.iter().for_each(|(who, what, _)| *counts.entry((who.as_str(), *what)).or_default() += 1);
    // 4 strategies with 6 settings, 3 batches with 2, 3 barriers with 1
    assert_eq!(counts.len(), 4 * 6 + 3 * 2 + 3, "{counts:?}");
    for ((who, what), count) in counts {
        assert_eq!(count, if what == "kernels" { kernels.len() } else { 3 }, "{who} with {what}: {met:?}");
    }
    println!("each strategy with the kernels {kernels:?}");
}

#[test]
fn a_task_that_goes_through_several_splits_loads_each_once_for_all_its_rays() {
    let settings = JobSettings {
        memory_per_node: Some(2 * largest(&SCENES[4])),
        // small batches, so that a task's rays would come in many portions
        batch: 37,
        task_seconds: 0.05,
        ray_buffer: 64 << 20,
        ..small(Strategy::SchedulingGrid, &[1])
    };
    let made = render_local(&SCENES[4], &frame(), &sampling(5), &settings, &Silent).unwrap();
    assert!(made.film == *expected(5));
    // the split that holds decided hits may come once more
    let (passes, tasks) = (made.report.scene_passes, made.report.tasks);
    assert!(passes <= 1.2 * tasks as f64, "{passes} passes, {tasks} tasks");
}

#[test]
fn a_furnace_has_its_closed_form_through_every_strategy() {
    let scene = testing::prepared(&testing::furnace(), 5, true);
    // emission seen after 0, 1, 2 and 3 reflections of one half
    let frame = Frame { max_depth: 4, rr_depth: 100, ..testing::frame(&scene, [12, 12], 1) };
    let frame = Frame { camera: camera_inside(&scene, [12, 12]), ..frame };
    let exact = 1.0 + 0.5 + 0.25 + 0.125;
    for strategy in Strategy::ALL {
        let settings = JobSettings { memory_per_node: Some(2 * largest(&scene)), ..small(strategy, &[1, 1]) };
        let made = render_local(&scene, &frame, &sampling(64), &settings, &Silent).unwrap();
        let values: Vec<f64> = made.image.pixels.iter().map(|p| f64::from(p[1])).collect();
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let variance = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (n - 1.0);
        let error = (variance / n).sqrt();
        assert!((mean - exact).abs() < 4.0 * error && error < 0.005 * exact, "{strategy}: {mean} +- {error}");
    }
}

fn camera_inside(scene: &PreparedScene, size: [u32; 2]) -> rayherd_render::camera::Camera {
    let to_world = [[-1.0, 0.0, 0.0, 0.3], [0.0, 1.0, 0.0, 0.2], [0.0, 0.0, -1.0, 0.1]];
    rayherd_render::camera::Camera::new(&to_world, 60.0, size, scene.manifest.offset).unwrap()
}

#[test]
fn a_scene_that_fits_is_divided_and_no_ray_travels() {
    let settings = JobSettings { nodes: nodes(&[1, 1, 1]), replicas: 2, ..small(Strategy::Auto, &[1, 1, 1]) };
    // enough samples that three copies of a small scene are cheaper than rays under way
    let made = render_local(&SCENES[2], &frame(), &sampling(30), &settings, &Silent).unwrap();
    assert!(made.film == *expected(30));
    assert_eq!((made.report.hops, made.report.bytes_per_hop, made.report.rounds), (0, None, made.report.tasks));
    let rays = made.report.rays;
    assert_eq!((rays.camera, rays.merged), (40 * 24 * 30, 40 * 24 * 30));
    assert!(rays.closest > rays.camera && rays.shadow > 0);
}

#[test]
fn too_little_memory_says_how_much_is_needed() {
    let scene = &SCENES[1];
    let needed = largest(scene);
    let settings = JobSettings { memory_per_node: Some(needed - 1), ..JobSettings::default() };
    let error = render_local(scene, &frame(), &sampling(1), &settings, &Silent).err().unwrap();
    assert!(error.to_string().contains(&needed.to_string()) && error.is_users(), "{error}");
}

#[test]
fn a_target_error_ends_a_run_that_a_longer_one_repeats() {
    let target = Sampling { spp: 4096, target_error: Some(0.2), time_limit: None };
    let made = render_local(&SCENES[1], &frame(), &target, &small(Strategy::Auto, &[2]), &Silent).unwrap();
    assert_eq!(made.report.target_reached, Some(true));
    assert!(made.report.rel_mse.unwrap() <= 0.2 && made.samples.most() < 4096, "{:?}", made.report.rel_mse);
    assert!(made.film == *expected(made.samples.most()));
    let late = Sampling { spp: 1 << 20, target_error: None, time_limit: Some(0.0) };
    let made = render_local(&SCENES[1], &frame(), &late, &small(Strategy::Auto, &[2]), &Silent).unwrap();
    assert!(made.film == *expected(made.samples.most()) && made.samples.most() < 100);
}

pub(super) fn with_store(store: &Arc<MemoryStore>, resume: bool, settings: JobSettings) -> JobSettings {
    let commits = Commits { store: store.clone(), resume, takeover: false };
    JobSettings { commits: Some(commits), ..settings }
}

#[test]
fn more_samples_continue_a_finished_image() {
    for strategy in Strategy::ALL {
        let store = Arc::new(MemoryStore::default());
        let settings = JobSettings { memory_per_node: Some(2 * largest(&SCENES[1])), ..small(strategy, &[1, 2]) };
        let first =
            render_local(&SCENES[1], &frame(), &sampling(3), &with_store(&store, false, settings.clone()), &Silent);
        assert!(first.unwrap().film == *expected(3));
        let again = with_store(&store, false, settings.clone());
        assert!(matches!(
            render_local(&SCENES[1], &frame(), &sampling(5), &again, &Silent),
            Err(JobError::Settings(_))
        ));
        let more =
            render_local(&SCENES[1], &frame(), &sampling(5), &with_store(&store, true, settings.clone()), &Silent)
                .unwrap();
        assert!(more.film == *expected(5), "{strategy}");
        assert!(more.report.tasks_reused > 0 && more.report.rays.camera == 40 * 24 * 5);
        // another cut of the same scene goes on as well, as nothing waits
        let finished = render_local(
            &SCENES[2],
            &frame(),
            &sampling(5),
            &with_store(&store, true, JobSettings::default()),
            &Silent,
        )
        .unwrap();
        assert!(finished.film == *expected(5) && finished.report.tasks == 0);
        let fewer = render_local(&SCENES[1], &frame(), &sampling(4), &with_store(&store, true, settings), &Silent);
        assert!(fewer.err().unwrap().to_string().contains("5 samples"));
        let other = Frame { seed: 8, ..frame() };
        let other =
            render_local(&SCENES[1], &other, &sampling(5), &with_store(&store, true, JobSettings::default()), &Silent);
        assert!(matches!(other, Err(JobError::Chain(_))));
    }
}

/// Stops a job by an error after some commits, as a kill would, but for the owner object.
pub(super) struct Crash {
    pub(super) after: u64,
    pub(super) store: Arc<MemoryStore>,
}

#[async_trait::async_trait]
impl BlockStore for Crash {
    async fn put(&self, key: &str, body: bytes::Bytes) -> Result<(), crate::store::StoreError> {
        let records = self.store.list("records/").await?;
        let last = records.last().map_or(0, |r| r.0[8..18].parse::<u64>().unwrap() + 1);
        if last >= self.after && key != "owner" {
            return Err(crate::store::StoreError::Unavailable {
                store: self.describe(),
                action: "put",
                key: key.to_owned(),
                message: "the test says so".into(),
            });
        }
        self.store.put(key, body).await
    }
    async fn get(&self, key: &str) -> Result<bytes::Bytes, crate::store::StoreError> {
        self.store.get(key).await
    }
    async fn size(&self, key: &str) -> Result<Option<u64>, crate::store::StoreError> {
        self.store.size(key).await
    }
    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, crate::store::StoreError> {
        self.store.list(prefix).await
    }
    async fn delete(&self, keys: &[String]) -> Result<(), crate::store::StoreError> {
        self.store.delete(keys).await
    }
    fn describe(&self) -> String {
        "a store that fails".into()
    }
}

#[test]
fn what_was_committed_before_a_crash_is_taken_over() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
    for (i, strategy) in Strategy::ALL.into_iter().enumerate() {
        let store = Arc::new(MemoryStore::default());
        let settings = JobSettings {
            memory_per_node: Some(2 * largest(&SCENES[1])),
            task_seconds: 0.002,
            ..small(strategy, if i % 2 == 0 { &[1] } else { &[1, 1] })
        };
        let mut crashes = 0;
        let mut reused = 0;
        for after in (3..).step_by(9) {
            let failing = Arc::new(Crash { after, store: store.clone() });
            let commits = Commits { store: failing, resume: true, takeover: true };
            let settings = JobSettings { commits: Some(commits), ..settings.clone() };
            match render_local(&SCENES[1], &frame(), &sampling(5), &settings, &Silent) {
                Ok(made) => {
                    assert!(made.film == *expected(5), "{strategy}");
                    reused = made.report.tasks_reused;
                    break;
                }
                Err(JobError::Store(_)) => crashes += 1,
                Err(e) => panic!("{strategy}: {e}"),
            }
            if crashes == 2 {
                // in the middle of everything, a collection takes nothing that is needed
                runtime.block_on(store.delete(&["owner".to_owned()])).unwrap();
                let collected = runtime.block_on(collect(store.clone())).unwrap();
                assert!(collected.kept > 0);
            }
        }
        assert!(crashes > 0 && reused > 0, "{strategy}: {crashes} crashes, {reused} reused");
    }
}

/// Commits that a store's records say, of one writer after the other.
fn committed(store: &MemoryStore) -> u64 {
    let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
    let mut records: Vec<_> = runtime.block_on(journal::read(store)).unwrap().into_values().collect();
    records.sort_by_key(|record| record.sequence);
    records.iter().fold(0, |commits, record| record.snapshot.as_ref().map_or(commits + 1, |s| s.commits))
}

/// The disk is full again and again, each time a larger one is there with what the one before held.
#[test]
fn a_store_that_becomes_full_keeps_what_is_committed() {
    let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
    for strategy in Strategy::ALL {
        let settings = JobSettings {
            memory_per_node: Some(2 * largest(&SCENES[1])),
            task_seconds: 0.002,
            ..small(strategy, &[1, 2])
        };
        let (mut room, mut midway) = (4096, 0);
        let mut store = Arc::new(MemoryStore::with_limit(room));
        loop {
            let before = committed(&store);
            let run = with_store(&store, true, settings.clone());
            let error = match render_local(&SCENES[1], &frame(), &sampling(5), &run, &Silent) {
                Ok(made) => {
                    assert!(made.film == *expected(5), "{strategy}");
                    let found = (made.report.tasks_reused, made.report.tasks_redone);
                    assert_eq!(found, (before, 0), "{strategy}");
                    assert!(before > 0, "{strategy}");
                    break;
                }
                Err(error) => error,
            };
            assert!(matches!(&error, JobError::Store(crate::store::StoreError::Full { .. })), "{strategy}: {error}");
            assert!(error.to_string().contains("no room for ") && !error.is_users(), "{strategy}: {error}");
            let after = committed(&store);
            assert!(after >= before, "{strategy}: {after} commits, there were {before}");
            midway += u32::from(after > before);
            room *= 2;
            let larger = Arc::new(MemoryStore::with_limit(room));
            for (key, _) in runtime.block_on(store.list("")).unwrap() {
                let body = runtime.block_on(store.get(&key)).unwrap();
                runtime.block_on(larger.put(&key, body)).unwrap();
            }
            store = larger;
        }
        assert!(midway > 1, "{strategy}: it was full between commits {midway} times");
    }
}

#[test]
fn corrupt_objects_are_found_and_computed_again() {
    let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
    let settings = JobSettings { memory_per_node: Some(2 * largest(&SCENES[1])), ..small(Strategy::Auto, &[1]) };
    for prefix in ["records/", "nodes/0/film/", "nodes/0/rays/"] {
        let store = Arc::new(MemoryStore::default());
        let failing = Arc::new(Crash { after: 9, store: store.clone() });
        let crashing =
            JobSettings { commits: Some(Commits { store: failing, resume: true, takeover: true }), ..settings.clone() };
        assert!(render_local(&SCENES[1], &frame(), &sampling(5), &crashing, &Silent).is_err());
        let keys = runtime.block_on(store.list(prefix)).unwrap();
        let last = &keys.last().unwrap_or_else(|| panic!("nothing in {prefix}")).0;
        let mut body = runtime.block_on(store.get(last)).unwrap().to_vec();
        let middle = body.len() / 2;
        body[middle] ^= 1;
        runtime.block_on(store.put(last, body.into())).unwrap();
        let commits = Commits { store: store.clone(), resume: true, takeover: true };
        let made = render_local(
            &SCENES[1],
            &frame(),
            &sampling(5),
            &JobSettings { commits: Some(commits), ..settings.clone() },
            &Silent,
        )
        .unwrap();
        assert!(made.film == *expected(5), "{prefix}");
    }
}

#[test]
fn a_straggler_is_beaten_by_a_second_attempt_and_leaves_nothing() {
    for strategy in Strategy::ALL {
        let store = Arc::new(MemoryStore::default());
        // whatever runs while a slot is idle gets a second attempt; the first one of all reports only once it is beaten
        let settings = JobSettings {
            memory_per_node: Some(2 * largest(&SCENES[1])),
            straggler_seconds: Some(0.0),
            threads: NonZeroU32::new(2),
            faults: Some(faults::Faults::first(faults::Fate::Straggle)),
            ..small(strategy, &[1, 1])
        };
        let made =
            render_local(&SCENES[1], &frame(), &sampling(5), &with_store(&store, false, settings), &Silent).unwrap();
        assert!(made.film == *expected(5), "{strategy}");
        assert!(made.report.attempts_lost > 0 && made.report.tasks_redone == 0, "{strategy}: {:?}", made.report);
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let left = runtime.block_on(store.list("nodes/")).unwrap();
        assert!(!left.is_empty() && !left.iter().any(|k| k.0.contains("t00000000-a0")), "{strategy}: {left:?}");
    }
}

/// Ends a job when it has made some commits.
struct Impatient {
    after: u64,
    commits: std::sync::atomic::AtomicU64,
}

impl Progress for Impatient {
    fn status(&self, status: &crate::job::Status) {
        self.commits.store(status.rounds, std::sync::atomic::Ordering::Relaxed);
    }
    fn is_cancelled(&self) -> bool {
        self.commits.load(std::sync::atomic::Ordering::Relaxed) >= self.after
    }
}

#[test]
fn a_job_that_is_told_to_end_keeps_what_is_committed_and_gives_the_store_back() {
    let store = Arc::new(MemoryStore::default());
    let settings = JobSettings { memory_per_node: Some(2 * largest(&SCENES[1])), ..small(Strategy::Auto, &[1]) };
    let impatient = Impatient { after: 3, commits: Default::default() };
    let stopped =
        render_local(&SCENES[1], &frame(), &sampling(5), &with_store(&store, false, settings.clone()), &impatient);
    assert!(matches!(stopped, Err(JobError::Cancelled)));
    let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
    assert!(runtime.block_on(store.list("owner")).unwrap().is_empty());
    let made = render_local(&SCENES[1], &frame(), &sampling(5), &with_store(&store, true, settings), &Silent).unwrap();
    assert!(made.film == *expected(5) && made.report.tasks_reused >= 3);
}

#[test]
fn what_is_the_networks_is_not_the_users() {
    let at = || ("s3://b".to_owned(), "owner".to_owned());
    let unavailable = |(store, key): (String, String)| crate::store::StoreError::Unavailable {
        store,
        action: "get",
        key,
        message: "connection refused".into(),
    };
    let denied = |(store, key): (String, String)| crate::store::StoreError::Denied {
        store,
        action: "get",
        key,
        message: "InvalidAccessKeyId".into(),
    };
    let object = |source: crate::store::StoreError| {
        JobError::Object(rayherd_scene::objects::ObjectError::Failed {
            store: "s3://b".into(),
            action: "read".into(),
            source: Box::new(source),
        })
    };
    assert!(!JobError::Store(unavailable(at())).is_users() && !object(unavailable(at())).is_users());
    assert!(JobError::Store(denied(at())).is_users() && object(denied(at())).is_users());
    assert!(!JobError::Lost { name: "rays/a".into(), why: "gone".into() }.is_users());
    assert!(JobError::Settings("no".into()).is_users());
}

/// Seeds of cases: the one that the environment asks for, once or `RAYHERD_FAULT_CASES` times; else one in `share` of as many as it asks
/// for, or of `cases`.
fn fault_seeds(cases: u64, share: u64) -> Vec<u64> {
    let from_env =
        |name: &str| std::env::var(name).ok().map(|v| v.parse::<u64>().unwrap_or_else(|_| panic!("{name}={v}")));
    match (from_env("RAYHERD_FAULT_SEED"), from_env("RAYHERD_FAULT_CASES")) {
        (Some(seed), times) => vec![seed; times.unwrap_or(1) as usize],
        (None, asked) => (0..asked.unwrap_or(cases) / share).collect(),
    }
}

/// Whether they are of different cases, which together must have done something.
fn are_many(seeds: &[u64]) -> bool {
    seeds.len() > 1 && seeds[0] != seeds[1]
}

/// Threads for all cases instead of what their seeds draw.
fn fault_threads() -> Option<NonZeroU32> {
    let text = std::env::var("RAYHERD_FAULT_THREADS").ok()?;
    Some(text.parse().unwrap_or_else(|_| panic!("RAYHERD_FAULT_THREADS={text}")))
}

/// How to see a case that failed again. On one thread a run is a function of its seed; on more their race takes part in it, so that a
/// case that passes on one has to be tried again and again.
fn replay(seed: u64, threads: u32, fails_on_one: bool) -> String {
    let how = if fails_on_one {
        format!("RAYHERD_FAULT_SEED={seed} RAYHERD_FAULT_THREADS=1")
    } else {
        format!("RAYHERD_FAULT_SEED={seed} RAYHERD_FAULT_THREADS={threads} RAYHERD_FAULT_CASES=1000")
    };
    let race = if fails_on_one { "" } else { " (it passes on one thread: a race)" };
    format!("replay with {how} cargo test --workspace --lib -- random_faults{race}")
}

/// Random settings and faults from a seed.
fn random_case(seed: u64) -> (&'static PreparedScene, JobSettings) {
    let pick = |i: u64, n: u64| faults::Faults::new(seed ^ 0x5eed).pick(i, n);
    let scene = &SCENES[pick(0, SCENES.len() as u64) as usize];
    let slots: Vec<u32> = (0..1 + pick(1, 4)).map(|i| 1 + pick(20 + i, 3) as u32).collect();
    let kernels = kernels();
    let settings = JobSettings {
        memory_per_node: [None, Some(largest(scene)), Some(2 * largest(scene)), Some(3 * largest(scene))]
            [pick(2, 4) as usize],
        replicas: 1 + pick(3, slots.len().min(3) as u64) as u32,
        barrier: [None, Some(true), Some(false)][pick(4, 3) as usize],
        task_seconds: [0.002, 0.01, 10.0][pick(5, 3) as usize],
        straggler_seconds: Some(0.01),
        threads: NonZeroU32::new(1 + pick(6, 3) as u32),
        kernel: kernels[pick(7, kernels.len() as u64) as usize],
        batch: [30, 300, 4000][pick(8, 3) as usize],
        ray_buffer: [1 << 14, 1 << 20][pick(9, 2) as usize],
        faults: Some(faults::Faults::new(seed)),
        ..small(Strategy::ALL[pick(10, 4) as usize], &slots)
    };
    let settings =
        if pick(11, 3) == 0 { with_store(&Arc::new(MemoryStore::default()), false, settings) } else { settings };
    (scene, settings)
}

#[test]
fn random_faults_change_nothing() {
    let seeds = fault_seeds(200, 1);
    let (mut lost, mut redone) = (0, 0);
    let plain = JobSettings { kernel: Kernel::Scalar, ..JobSettings::default() };
    let expected = render_local(&SCENES[0], &small_frame(), &sampling(2), &plain, &Silent).unwrap().film;
    let many = are_many(&seeds);
    let run = |seed: u64, threads: Option<NonZeroU32>| {
        let (scene, settings) = random_case(seed);
        let settings = JobSettings { threads: threads.or(settings.threads), ..settings };
        let failed = |what: &str| (format!("{what}; {settings:?}"), settings.threads.map_or(1, NonZeroU32::get));
        match render_local(scene, &small_frame(), &sampling(2), &settings, &Silent) {
            Ok(made) if made.film == expected => Ok(made.report),
            Ok(_) => Err(failed("another image")),
            Err(e) => Err(failed(&e.to_string())),
        }
    };
    for seed in seeds {
        let report = run(seed, fault_threads()).unwrap_or_else(|(what, threads)| {
            let fails_on_one = run(seed, NonZeroU32::new(1)).is_err();
            panic!("{}: {what}", replay(seed, threads, fails_on_one))
        });
        lost += report.attempts_lost;
        redone += report.tasks_redone;
    }
    // the schedules do what they are for
    assert!(!many || (lost > 100 && redone > 10), "{lost} attempts lost, {redone} tasks computed again");
}

/// Every kind of emitter: a picture of the sky, a point, a spot, parallel light, a lamp. The same bytes whichever way.
#[test]
fn every_emitter_makes_the_same_bytes() {
    use rayherd_scene::description::{Affine, Beam, Environment, Place};
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("sky.hdr");
    let mut sky = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 5 +X 6\n".to_vec();
    sky.extend((0..30u8).flat_map(|i| [20 + 7 * i, 250 - 5 * i, i, if i == 8 { 133 } else { 126 }]));
    std::fs::write(&path, sky).unwrap();
    let turned = Affine([[0.0, 0.6, 0.8, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.8, -0.6, 0.0]]);
    let position = [0.3, 0.4, 0.9];
    let (axis, intensity) = ([-0.6, -0.8, 0.0], [0.5, 0.6, 0.7]);
    let description = rayherd_scene::description::Description {
        beams: vec![
            Beam::Point { position, intensity },
            Beam::Spot { position, axis, intensity: [3.0; 3], beam: 20.0, cutoff: 50.0, slide: None },
            Beam::Directional { direction: [0.0, -0.6, -0.8], irradiance: [1.0, 0.9, 0.8] },
        ],
        environment: Some(Environment::Map { path, place: Place::default(), scale: 0.25, to_world: turned }),
        ..testing::cornell()
    };
    let whole = testing::prepared(&description, 1, true);
    assert!(whole.manifest.sky_map.is_some());
    let frame = testing::frame(&whole, [24, 16], 2);
    let settings = JobSettings { kernel: Kernel::Scalar, ..JobSettings::default() };
    let expected = render_local(&whole, &frame, &sampling(4), &settings, &Silent).unwrap();
    let dark = rayherd_scene::description::Description { beams: vec![], environment: None, ..testing::cornell() };
    let dark = testing::prepared(&dark, 1, true);
    assert!(expected.film != render_local(&dark, &frame, &sampling(4), &settings, &Silent).unwrap().film);
    for (splits, reduced) in [(5, true), (5, false)] {
        let scene = testing::prepared(&description, splits, reduced);
        for strategy in Strategy::ALL {
            let settings = JobSettings { memory_per_node: Some(2 * largest(&scene)), ..small(strategy, &[2, 1]) };
            let made = render_local(&scene, &frame, &sampling(4), &settings, &Silent).unwrap();
            assert!(made.film == expected.film, "{strategy} on {splits} splits");
        }
    }
}

#[test]
fn a_seed_repeats_its_whole_run_on_one_thread() {
    let (mut hits, mut lost) = (0, 0);
    for seed in 0..24 {
        let run = || {
            let (scene, settings) = random_case(seed);
            let settings = JobSettings { threads: NonZeroU32::new(1), ..settings };
            let made = render_local(scene, &small_frame(), &sampling(2), &settings, &Silent).unwrap();
            let r = made.report;
            let moved = r.bytes.iter().filter(|b| b.kind != crate::report::Kind::Film);
            let counts = (r.tasks, r.rounds, r.tasks_redone, r.attempts_lost, r.hops, r.rays);
            (settings.faults.unwrap().log(), counts, moved.copied().collect::<Vec<_>>())
        };
        let (first, second) = (run(), run());
        assert!(first.0 == second.0, "seed {seed}: another schedule");
        assert_eq!(first.1, second.1, "seed {seed}");
        assert_eq!(first.2, second.2, "seed {seed}");
        hits += first.0.iter().filter(|l| l.2 != faults::Fate::Fine).count();
        lost += first.1.3;
    }
    assert!(hits > 50 && lost > 10, "{hits} faults, {lost} attempts lost");
}

/// Changes a byte of one object of a job's store, or takes half of it away; its key.
fn damage(store: &MemoryStore, prefix: &str, pick: &dyn Fn(u64) -> u64) -> Option<String> {
    let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
    let keys = runtime.block_on(store.list(prefix)).unwrap();
    let (key, _) = keys.get(pick(keys.len() as u64) as usize)?.clone();
    let mut body = runtime.block_on(store.get(&key)).unwrap().to_vec();
    if pick(3) == 0 {
        body.truncate(body.len() / 2);
    } else {
        let at = pick(body.len() as u64) as usize;
        body[at] ^= 1 << pick(8);
    }
    runtime.block_on(store.put(&key, body.into())).unwrap();
    Some(key)
}

#[test]
fn crashes_and_damage_between_them_change_nothing() {
    let plain = JobSettings { kernel: Kernel::Scalar, ..JobSettings::default() };
    let expected = render_local(&SCENES[0], &small_frame(), &sampling(2), &plain, &Silent).unwrap().film;
    let seeds = fault_seeds(200, 4);
    let (cases, many) = (seeds.len() as u64, are_many(&seeds));
    let (mut crashes, mut reused, mut redone, mut refused) = (0, 0, 0, 0);
    for seed in seeds {
        let store = Arc::new(MemoryStore::default());
        let count = std::cell::Cell::new(0);
        let pick = |n: u64| {
            count.set(count.get() + 1);
            faults::Faults::new(seed ^ 0xc4a5).pick(count.get(), n)
        };
        let mut done = false;
        // far more than it takes: a slow machine cuts its tasks smaller, and commits more often
        for run in 0..1000 {
            let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
            let records = runtime.block_on(store.list("records/")).unwrap();
            let next = records.last().map_or(0, |r| r.0[8..18].parse::<u64>().unwrap() + 1);
            // now and then under another strategy, which may cut the scene otherwise, and on other nodes
            let (scene, settings) = random_case(if pick(3) == 0 { seed + run } else { seed });
            let failing = Arc::new(Crash { after: next + 1 + pick(12), store: store.clone() });
            let commits = Commits { store: failing, resume: true, takeover: true };
            let threads = fault_threads().or(settings.threads);
            let settings = JobSettings { commits: Some(commits), task_seconds: 0.001, threads, ..settings };
            match render_local(scene, &small_frame(), &sampling(2), &settings, &Silent) {
                Ok(made) => {
                    assert!(made.film == expected, "another image: case {seed}");
                    (reused, redone) = (reused + made.report.tasks_reused, redone + made.report.tasks_redone);
                    done = true;
                    break;
                }
                Err(JobError::Store(_)) => {
                    crashes += 1;
                    damage(&store, ["records/", "nodes/", "nodes/0/film/"][pick(3) as usize], &pick);
                }
                // the only record, or the first: nothing to begin from, and that is said
                Err(JobError::Chain(_)) => {
                    refused += 1;
                    let all: Vec<String> = runtime.block_on(store.list("")).unwrap().into_iter().map(|k| k.0).collect();
                    runtime.block_on(store.delete(&all)).unwrap();
                }
                Err(e) => panic!("case {seed}: {e}"),
            }
        }
        assert!(done, "case {seed} does not end");
    }
    if many {
        assert!(crashes as u64 > cases && reused > cases && redone > 0, "{crashes}, {reused}, {redone}, {refused}");
        assert!(refused < crashes / 2, "{refused} of {crashes} were refused");
    }
}
