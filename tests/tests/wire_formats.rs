//! What a prepared scene and a job leave in a store, damaged behind the checksums, and job files: read or refused, without a panic, in
//! bounded time and memory. (Geometry, attributes, film, ray groups and envelopes alone are damaged where they are defined.) Pictures too: tiles of
//! textures and the sky.

use std::path::Path;
use std::sync::{Arc, LazyLock};

use rayherd_api::{RenderJob, RenderJobSpec, Strategy, validate};
use rayherd_herd::job::spec::{frame, import_options, prepare_settings};
use rayherd_herd::job::{Commits, JobError, JobSettings, NodeSpec, PreparedScene, Sampling, Silent};
use rayherd_herd::local::{collect, render_local};
use rayherd_herd::store::{BlockStore, MemoryStore};
use rayherd_herd::wire::envelope::{Compress, Kind, open, seal};
use rayherd_render::frame::Frame;
use rayherd_render::light::SkyMap;
use rayherd_scene::import::{DescriptionSource, StreamOptions, import};
use rayherd_scene::manifest::Manifest;
use rayherd_scene::objects::{MemoryObjects, ObjectKind, ObjectRef, ObjectStore};
use rayherd_scene::prepare::{NoProgress, SpoolSettings, prepare};
use rayherd_tests::mutation;

/// A small job: its spec, its scene, cut in three, and the objects of that.
struct Job {
    spec: RenderJobSpec,
    manifest: Manifest,
    objects: MemoryObjects,
}

/// Spheres, rough metal and several lamps, in few pixels.
static JOB: LazyLock<Job> =
    LazyLock::new(|| job(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/veach-mis.xml")));

/// A wall and a lamp with a picture each, under a picture of the sky.
static PICTURES: LazyLock<Job> = LazyLock::new(|| {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("wire-formats");
    std::fs::create_dir_all(&folder).unwrap();
    // 150 texels across are two tiles
    for (name, width, height) in [("wall", 150u32, 3u32), ("lamp", 2, 2), ("sky", 6, 5)] {
        let mut picture = format!("#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n").into_bytes();
        picture
            .extend((0..width * height).flat_map(|i| [40 + i as u8 % 200, 250 - i as u8 % 150, 9, 127 + i as u8 % 3]));
        std::fs::write(folder.join(format!("{name}.hdr")), picture).unwrap();
    }
    let picture = |property: &str, name: &str| {
        format!("<texture type='bitmap' name='{property}'><string name='filename' value='{name}.hdr'/></texture>")
    };
    let text = format!(
        "<scene version='3.0.0'><emitter type='envmap'><string name='filename' value='sky.hdr'/></emitter>\n\
         <shape type='rectangle'><bsdf type='twosided'><bsdf type='diffuse'>{}</bsdf></bsdf></shape>\n\
         <shape type='sphere'><point name='center' x='0' y='0' z='1.5'/><float name='radius' value='0.3'/>\
         <emitter type='area'>{}</emitter></shape></scene>",
        picture("reflectance", "wall"),
        picture("radiance", "lamp")
    );
    let scene = folder.join("scene.xml");
    std::fs::write(&scene, text).unwrap();
    job(&scene)
});

fn job(scene: &Path) -> Job {
    let mut spec = RenderJobSpec { splits: Some(3), ..RenderJobSpec::default() };
    spec.scene.source = scene.to_string_lossy().into_owned();
    spec.image.size = Some("6x5".parse().unwrap());
    let description = import(scene, &import_options(&spec)).unwrap();
    let source = DescriptionSource::new(&description, StreamOptions::default());
    let objects = MemoryObjects::new();
    let (settings, spool) = (prepare_settings(&spec), SpoolSettings::default());
    let made = prepare(&description, &source, &settings, &spool, &objects, &NoProgress).unwrap();
    Job { spec, manifest: made.manifest, objects }
}

fn settings(commits: Option<Commits>) -> JobSettings {
    JobSettings {
        strategy: Strategy::SchedulingGridOverlapReduced,
        nodes: vec![NodeSpec { slots: 2 }],
        task_seconds: 0.001,
        batch: 16,
        commits,
        ..JobSettings::default()
    }
}

const SPP: u32 = 3;

fn render(scene: &PreparedScene, frame: &Frame, commits: Option<Commits>) -> Result<(), JobError> {
    let sampling = Sampling { spp: SPP, target_error: None, time_limit: None };
    render_local(scene, frame, &sampling, &settings(commits), &Silent).map(|_| ())
}

/// No loop may take more memory than this: what is damaged is some kilobytes.
fn bounded(run: impl FnOnce()) {
    let before = mutation::peak_memory();
    run();
    if let (Some(before), Some(after)) = (before, mutation::peak_memory()) {
        let more = after.saturating_sub(before);
        assert!(more < 256 << 10, "it took {} MiB more", more >> 10);
    }
}

/// A scene under another manifest, with the objects of [`JOB`] and one more.
fn scene(manifest: Manifest, more: &[u8]) -> Result<PreparedScene, JobError> {
    scene_of(&JOB, manifest, more)
}

fn scene_of(job: &Job, manifest: Manifest, more: &[u8]) -> Result<PreparedScene, JobError> {
    let objects = MemoryObjects::new();
    for bytes in job.objects.snapshot().values() {
        objects.put(ObjectKind::Geometry, bytes).unwrap();
    }
    objects.put(ObjectKind::Geometry, more).unwrap();
    PreparedScene::open(manifest, Arc::new(objects))
}

/// The objects of a scene that name the right hash, and lie.
#[test]
fn scenes() {
    let frame = frame(&JOB.spec, &JOB.manifest, None).unwrap();
    render(&scene(JOB.manifest.clone(), &[]).unwrap(), &frame, None).unwrap();
    let read = |object: &ObjectRef| JOB.objects.get(object).unwrap();
    bounded(|| {
        let (mut rendered, mut refused) = (0, 0);
        let rounds = mutation::rounds("objects of a scene", 250, |random| {
            let mut manifest = JOB.manifest.clone();
            let which = random.below(4);
            let split = random.below(manifest.splits.len());
            let entry = match which {
                0 | 1 => &mut manifest.world,
                2 => &mut manifest.splits[split].attributes,
                _ => &mut manifest.splits[split].geometry,
            };
            let valid = read(entry);
            let bad = if which < 2 {
                mutation::text(&valid, &["1e39", "-1e39", "1e-45"], random)
            } else {
                mutation::bytes(&valid, random)
            };
            *entry = ObjectRef::of(&bad);
            match scene(manifest, &bad).and_then(|scene| render(&scene, &frame, None)) {
                Ok(()) => rendered += 1,
                Err(e) => {
                    assert!(e.is_users(), "{e}");
                    refused += 1;
                }
            }
        });
        println!("{rendered} rendered, {refused} refused");
        assert!(rounds.is_none_or(|n| rendered > n / 50 && refused > n / 50), "{rendered}, {refused} of {rounds:?}");
    });
}

/// Tiles of textures and the sky of a scene that have the right hash, and lie: what has the size that it should have is rendered, whatever it
/// shows.
#[test]
fn pictures() {
    let job = &*PICTURES;
    let frame = frame(&job.spec, &job.manifest, None).unwrap();
    render(&scene_of(job, job.manifest.clone(), &[]).unwrap(), &frame, None).unwrap();
    assert_eq!(job.manifest.tiles.len(), 3);
    for (which, name) in ["tiles of textures", "sky of a scene"].into_iter().enumerate() {
        bounded(|| {
            let (mut rendered, mut refused) = (0, 0);
            let rounds = mutation::rounds(name, 400, |random| {
                let mut manifest = job.manifest.clone();
                let entry = match which {
                    0 => manifest.tiles.get_mut(random.below(3)),
                    _ => manifest.sky_map.as_mut(),
                };
                let entry = entry.unwrap();
                let bad = mutation::bytes(&job.objects.get(entry).unwrap(), random);
                *entry = ObjectRef::of(&bad);
                match scene_of(job, manifest, &bad).and_then(|scene| render(&scene, &frame, None)) {
                    Ok(()) => rendered += 1,
                    Err(e) => {
                        assert!(e.is_users(), "{e}");
                        refused += 1;
                    }
                }
            });
            println!("{name}: {rendered} rendered, {refused} refused");
            assert!(
                rounds.is_none_or(|n| rendered > n / 10 && refused > n / 10),
                "{rendered}, {refused} of {rounds:?}"
            );
        });
    }
}

/// The bytes of a sky alone: no map, or the map of these bytes, whose tables hold together.
#[test]
fn sky_maps() {
    let object = PICTURES.manifest.sky_map.as_ref().unwrap();
    let valid = PICTURES.objects.get(object).unwrap();
    bounded(|| {
        let (mut maps, mut refused) = (0, 0);
        let rounds = mutation::rounds("sky map", 20_000, |random| {
            let bad = mutation::bytes(&valid, random);
            let Ok(map) = SkyMap::decode(&bad) else {
                refused += 1;
                return;
            };
            maps += 1;
            assert!(map.encode() == bad);
            let direction = map.sample([random.bits() as u32, random.bits() as u32]);
            assert!(map.pdf(direction) >= 0.0 && map.radiance(direction).min_element() >= 0.0);
        });
        assert!(rounds.is_none_or(|n| maps > n / 10 && refused > n / 10), "{maps}, {refused} of {rounds:?}");
    });
}

/// A manifest that is well-formed, and lies.
#[test]
fn manifests() {
    let valid = JOB.manifest.encode();
    bounded(|| {
        let (mut rendered, mut refused) = (0, 0);
        let rounds = mutation::rounds("manifest of a scene", 3000, |random| {
            let bad = mutation::text(&valid, &[], random);
            let Ok(manifest) = Manifest::decode(&bad) else { return };
            // what the lie is about may not matter: the settings, a count
            let made = frame(&JOB.spec, &manifest, None)
                .and_then(|frame| scene(manifest, &[]).and_then(|scene| render(&scene, &frame, None)));
            match made {
                Ok(()) => rendered += 1,
                Err(_) => refused += 1,
            }
        });
        println!("{rendered} rendered, {refused} refused");
        assert!(rounds.is_none_or(|n| rendered + refused > n / 200), "{rendered}, {refused} of {rounds:?}");
    });
}

type Objects = Vec<(String, bytes::Bytes)>;

async fn all(store: &dyn BlockStore) -> Objects {
    let mut found = Vec::new();
    for (key, _) in store.list("").await.unwrap() {
        found.push((key.clone(), store.get(&key).await.unwrap()));
    }
    found
}

/// A job whose last round record has the right hash, and lies: it is gone on with, made again or refused, and collected.
#[test]
fn round_records() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
    let frame = frame(&JOB.spec, &JOB.manifest, None).unwrap();
    let whole = scene(JOB.manifest.clone(), &[]).unwrap();
    let store = Arc::new(MemoryStore::new());
    let commits = |store: &Arc<MemoryStore>| Commits { store: store.clone(), resume: true, takeover: true };
    render(&whole, &frame, Some(commits(&store))).unwrap();
    let objects = runtime.block_on(all(store.as_ref()));
    let (records, others): (Objects, Objects) = objects.into_iter().partition(|(key, _)| key.starts_with("records/"));
    assert!(records.len() > 5, "{} records", records.len());
    bounded(|| {
        let (mut went_on, mut refused) = (0, 0);
        let rounds = mutation::rounds("round records", 250, |random| {
            let last = random.below(records.len());
            let json = open(Kind::RoundRecord, &records[last].1, 1 << 20).unwrap();
            let bad = seal(Kind::RoundRecord, &mutation::text(&json, &["[]", "[[0,1]]"], random), Compress::Lz4);
            let place = records[last].0.split('-').next().unwrap();
            let store = Arc::new(MemoryStore::new());
            runtime.block_on(async {
                for (key, body) in others.iter().chain(&records[..last]) {
                    store.put(key, body.clone()).await.unwrap();
                }
                store.put(&format!("{place}-{}", blake3::hash(&bad).to_hex()), bad).await.unwrap();
                if random.below(2) == 0 {
                    // what may be collected is found, or the job is refused
                    let _ = collect(store.clone()).await;
                }
            });
            match render(&whole, &frame, Some(commits(&store))) {
                Ok(()) => went_on += 1,
                Err(_) => refused += 1,
            }
        });
        println!("{went_on} went on, {refused} refused");
        assert!(rounds.is_none_or(|n| went_on > n / 50 && refused > n / 50), "{went_on}, {refused} of {rounds:?}");
    });
}

const YAML: &str = "apiVersion: rayherd.io/v1alpha1
kind: RenderJob
metadata: {name: two, labels: {a: b}}
spec:
  scene: {source: box.xml, iso: -789.5, albedo: [0.7], sky: [0.1, 0.2, 0.3], define: {spp: '4'}, substitute: true, lights: [{origin: [0, 5, 0], target: [0, 0, 0], size: [1, 1], radiance: [10]}]}
  image:
    size: 16x8
    output: a.exr
    exposure: 0.5
    cameras:
    - {name: front, origin: [0, 1, 6.8], target: [0, 1, 0], fov: 20}
    - {origin: [0, 1, 6.8], target: [0, 0.5, 0], up: [0, 1, 0], fov: 30}
  sampling: {spp: 2, maxDepth: 3, rrDepth: 2, split: 2, seed: 7, targetError: 0.01, timeLimit: 5}
  strategy: SchedulingGridOverlapReduced
  splits: 3
  overlapThreshold: 0.2
  workers: {slots: [1, 1], memory: 8Ki}
  replicas: 2
  barrier: true
  taskSeconds: 10
";

#[test]
fn job_files() {
    let good: RenderJob = serde_yaml::from_str(YAML).unwrap();
    assert_eq!(validate(&good), []);
    let words =
        ["&a", "*a", "&a [*a, *a]", "<<: *a", "- ", "!!binary x", "blockSize: 64Mi", "8Ei", "65536x1", "~", "|"];
    bounded(|| {
        let (mut sound, mut refused) = (0, 0);
        let rounds = mutation::rounds("job file", 20_000, |random| {
            let bad = mutation::text(YAML.as_bytes(), &words, random);
            let Ok(text) = String::from_utf8(bad) else { return };
            let job: RenderJob = match serde_yaml::from_str(&text) {
                Ok(job) => job,
                Err(e) => {
                    assert!(e.to_string().len() < 10_000);
                    refused += 1;
                    return;
                }
            };
            if !validate(&job).is_empty() {
                refused += 1;
                return;
            }
            sound += 1;
            // what is sound can be used, whatever it says
            import_options(&job.spec);
            prepare_settings(&job.spec);
            assert!(job.spec.workers.slots_per_node(4).is_some());
            for camera in &job.spec.image.cameras {
                let _ = frame(&job.spec, &JOB.manifest, Some(camera));
            }
            let again: RenderJob = serde_yaml::from_str(&serde_yaml::to_string(&job).unwrap()).unwrap();
            assert_eq!(again, job);
        });
        assert!(rounds.is_none_or(|n| sound > n / 50 && refused > n / 50), "{sound}, {refused} of {rounds:?}");
    });
}

/// Names for names for names: nine lines that stand for a billion.
#[test]
fn a_job_file_that_swells() {
    let mut text = String::from("a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n");
    for i in 1..10 {
        let names = vec![format!("*a{}", i - 1); 10].join(", ");
        text += &format!("a{i}: &a{i} [{names}]\n");
    }
    bounded(|| assert!(serde_yaml::from_str::<RenderJob>(&text).is_err()));
    let deep = format!("spec: {}", "[".repeat(20_000));
    bounded(|| assert!(serde_yaml::from_str::<RenderJob>(&deep).is_err()));
}
