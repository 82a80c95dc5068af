//! Scenes on stores in memory, at times that are given; jobs that come at any step of a deletion.

use std::sync::Mutex;

use async_trait::async_trait;
use futures::FutureExt;
use rayherd_scene::import::{DescriptionSource, StreamOptions};
use rayherd_scene::objects::{MemoryObjects, ObjectStore};
use rayherd_scene::prepare::{Cut, NoProgress, PrepareSettings, SpoolSettings, prepare};

use super::*;
use crate::store::MemoryStore;

const DAY: u64 = 86_400;
const KEEP: std::time::Duration = std::time::Duration::from_secs(30 * DAY);
const NOW: u64 = 1_800_000_000;

/// What happens at a call; it may refuse it.
type Event = Box<dyn Fn(&str, &[String]) -> Result<(), StoreError> + Send + Sync>;

/// Memory that tells somebody of each put and delete before it happens.
#[derive(Default)]
struct Told {
    inner: MemoryStore,
    event: Mutex<Option<Arc<Event>>>,
}

impl Told {
    fn tell(&self, what: &str, keys: &[String]) -> Result<(), StoreError> {
        let event = self.event.lock().unwrap().clone();
        event.map_or(Ok(()), |event| event(what, keys))
    }
}

#[async_trait]
impl BlockStore for Told {
    async fn put(&self, key: &str, body: Bytes) -> Result<(), StoreError> {
        self.tell("put", &[key.to_owned()])?;
        self.inner.put(key, body).await
    }
    async fn get(&self, key: &str) -> Result<Bytes, StoreError> {
        self.inner.get(key).await
    }
    async fn size(&self, key: &str) -> Result<Option<u64>, StoreError> {
        self.inner.size(key).await
    }
    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError> {
        self.tell("list", &[prefix.to_owned()])?;
        self.inner.list(prefix).await
    }
    async fn delete(&self, keys: &[String]) -> Result<(), StoreError> {
        self.tell("delete", keys)?;
        self.inner.delete(keys).await
    }
    fn describe(&self) -> String {
        "told".into()
    }
}

fn away(what: &'static str) -> StoreError {
    StoreError::Unavailable { store: "told".into(), action: what, key: "any".into(), message: "away".into() }
}

/// A prepared scene, its objects at hand.
struct Made {
    manifest: Manifest,
    objects: MemoryObjects,
}

impl Made {
    fn new(splits: u32) -> Self {
        let objects = MemoryObjects::default();
        let settings = PrepareSettings { cut: Cut::Splits(splits), ..PrepareSettings::default() };
        let description = crate::testing::cornell();
        let spool = SpoolSettings::default();
        let source = DescriptionSource::new(&description, StreamOptions::default());
        let made = prepare(&description, &source, &settings, &spool, &objects, &NoProgress).unwrap();
        Made { manifest: made.manifest, objects }
    }
    /// The same objects for another picture.
    fn for_spp(&self, spp: u32) -> Manifest {
        let mut manifest = self.manifest.clone();
        manifest.defaults.spp = Some(spp);
        manifest
    }
}

/// Some stores, each with every so many-th object of a scene.
struct Servers(Vec<Arc<Told>>);

impl Servers {
    fn new(count: usize) -> Self {
        Servers((0..count).map(|_| Arc::default()).collect())
    }
    fn stores(&self) -> Vec<Arc<dyn BlockStore>> {
        self.0.iter().map(|s| s.clone() as Arc<dyn BlockStore>).collect()
    }
    /// Puts the objects of a scene, then its manifest and name on two of the servers.
    async fn prepare(&self, made: &Made, manifest: &Manifest, name: &str) -> ObjectHash {
        let count = self.0.len();
        for (number, object) in manifest.objects().enumerate() {
            let body = made.objects.get(object).unwrap();
            self.0[number % count].inner.put(&object_key(&object.hash), body.into()).await.unwrap();
        }
        let reference = manifest.reference();
        for server in [1 % count, 2 % count] {
            let server = &self.0[server].inner;
            server.put(&object_key(&reference.hash), manifest.encode().into()).await.unwrap();
            server.put(&format!("names/{name}"), serde_json::to_vec(&reference).unwrap().into()).await.unwrap();
        }
        reference.hash
    }
    async fn used(&self, scene: &ObjectHash, time: u64) {
        mark(&self.stores(), scene, time).await.unwrap();
    }
    /// As a job does: marks it, then looks whether it is there.
    fn used_and_there(servers: &[Arc<Told>], scene: &ObjectHash) -> bool {
        let stores: Vec<Arc<dyn BlockStore>> = servers.iter().map(|s| s.clone() as Arc<dyn BlockStore>).collect();
        mark(&stores, scene, NOW + 1).now_or_never().unwrap().unwrap();
        manifest(&stores, scene).now_or_never().unwrap().unwrap().is_some()
    }
    /// Whether a scene is there with all its objects, and its name.
    async fn whole(&self, scene: &ObjectHash) -> bool {
        let stores = self.stores();
        let Some((manifest, _)) = manifest(&stores, scene).await.unwrap() else { return false };
        let mut all = true;
        for object in manifest.objects() {
            let mut held = false;
            for server in &self.0 {
                held |= server.inner.size(&object_key(&object.hash)).await.unwrap().is_some();
            }
            all &= held;
        }
        all && find(&stores).await.unwrap().all[scene].names.len() == 2.min(self.0.len())
    }
    async fn keys(&self) -> Vec<String> {
        let mut keys = Vec::new();
        for server in &self.0 {
            keys.extend(server.inner.list("").await.unwrap().into_iter().map(|(key, _)| key));
        }
        keys
    }
    async fn sweep(&self, now: u64, used: &[ObjectHash]) -> Result<Swept, JobError> {
        let rules = Rules { now, keep: KEEP, used: &used.iter().copied().collect() };
        sweep(&self.stores(), &rules, || Some(())).await
    }
    /// Has something happen once, before the first call of this kind with such a key on any server.
    fn once(
        &self,
        what: &'static str,
        key: String,
        event: impl Fn(&[Arc<Told>]) -> Result<(), StoreError> + Send + Sync + 'static,
    ) {
        let servers: Vec<_> = self.0.iter().map(Arc::downgrade).collect();
        let event: Arc<Event> = Arc::new(Box::new(move |called, keys| {
            if called != what || !keys.iter().any(|k| k.starts_with(&key)) {
                return Ok(());
            }
            let servers: Vec<Arc<Told>> = servers.iter().map(|s| s.upgrade().unwrap()).collect();
            servers.iter().for_each(|s| *s.event.lock().unwrap() = None);
            event(&servers)
        }));
        self.0.iter().for_each(|s| *s.event.lock().unwrap() = Some(event.clone()));
    }
}

/// Any object of a scene that is deleted with it.
fn world(made: &Made) -> String {
    object_key(&made.manifest.world.hash)
}

#[tokio::test]
async fn a_scene_goes_when_nobody_has_used_it_for_its_time() {
    let made = Made::new(3);
    for count in [1, 3] {
        let servers = Servers::new(count);
        let scene = servers.prepare(&made, &made.manifest, "scene-a").await;
        servers.0[0].inner.put("output/n/j/j.exr", Bytes::from_static(b"picture")).await.unwrap();
        let before = servers.keys().await;
        // nobody has marked it: its time begins
        assert_eq!(servers.sweep(NOW, &[]).await.unwrap(), Swept::default());
        assert_eq!(servers.keys().await.len(), before.len() + count);
        assert_eq!(servers.sweep(NOW + KEEP.as_secs() - 1, &[]).await.unwrap(), Swept::default());
        // a job has it: its time begins anew
        assert_eq!(servers.sweep(NOW + KEEP.as_secs(), &[scene]).await.unwrap(), Swept::default());
        assert_eq!(servers.sweep(NOW + 2 * KEEP.as_secs() - 1, &[]).await.unwrap(), Swept::default());
        assert!(servers.whole(&scene).await);
        // a clock that was ahead
        servers.used(&scene, NOW + 100 * KEEP.as_secs()).await;
        assert_eq!(servers.sweep(NOW + 3 * KEEP.as_secs(), &[]).await.unwrap(), Swept::default());
        servers.used(&scene, NOW + KEEP.as_secs()).await;
        let swept = servers.sweep(NOW + 2 * KEEP.as_secs(), &[]).await.unwrap();
        let objects: BTreeSet<ObjectRef> = made.manifest.objects().copied().collect();
        let bytes = objects.iter().map(|o| o.bytes).sum();
        assert_eq!(swept, Swept { scenes: 1, objects: objects.len() as u64, bytes });
        assert_eq!(servers.keys().await, ["output/n/j/j.exr"]);
        assert_eq!(servers.sweep(NOW + 3 * KEEP.as_secs(), &[]).await.unwrap(), Swept::default());
    }
}

#[tokio::test]
async fn what_another_scene_has_stays_and_goes_with_the_last() {
    let (made, other) = (Made::new(3), Made::new(5));
    let servers = Servers::new(3);
    let first = servers.prepare(&made, &made.manifest, "scene-a").await;
    let again = made.for_spp(9);
    let second = servers.prepare(&made, &again, "scene-b").await;
    let third = servers.prepare(&other, &other.manifest, "scene-c").await;
    assert!(first != second && second != third);
    let (late, later) = (NOW + KEEP.as_secs(), NOW + 2 * KEEP.as_secs());
    for (scene, time) in [(first, NOW), (second, late), (third, late)] {
        servers.used(&scene, time).await;
    }
    // of the first nothing is its own but its manifest
    assert_eq!(servers.sweep(late, &[]).await.unwrap(), Swept { scenes: 1, objects: 0, bytes: 0 });
    assert!(!servers.whole(&first).await && servers.whole(&second).await && servers.whole(&third).await);
    // one that lost its name to another picture is a scene all the same, by its mark
    for server in &servers.0 {
        server.inner.delete(&["names/scene-b".to_owned()]).await.unwrap();
    }
    servers.used(&third, NOW).await;
    let theirs = |m: &Manifest| m.objects().map(|o| o.hash).collect::<BTreeSet<_>>();
    let own = theirs(&other.manifest).difference(&theirs(&again)).count() as u64;
    let swept = servers.sweep(late, &[]).await.unwrap();
    assert_eq!((swept.scenes, swept.objects), (1, own));
    for object in again.objects() {
        assert!(servers.keys().await.contains(&object_key(&object.hash)));
    }
    // both at once that share all
    let first = servers.prepare(&made, &made.manifest, "scene-a").await;
    servers.used(&first, NOW).await;
    assert_eq!(servers.sweep(later, &[]).await.unwrap().scenes, 2);
    assert_eq!(servers.keys().await, [""; 0]);
}

/// A job that marks the scene and then looks for it either finds it, and then it stays whole, or prepares it again.
#[tokio::test]
async fn a_job_that_comes_at_any_step_of_the_deletion_has_its_scene() {
    let made = Made::new(3);
    let hash = made.manifest.reference().hash;
    let steps = [
        ("delete", "names/".to_owned(), true),
        ("put", "going/".to_owned(), true),
        ("delete", object_key(&hash), true),
        // the manifest is gone, its mark not looked at yet
        ("list", "uses/".to_owned(), false),
        ("delete", world(&made), false),
        ("delete", format!("uses/{hash}"), false),
    ];
    for (what, key, found) in steps {
        let servers = Servers::new(3);
        let scene = servers.prepare(&made, &made.manifest, "scene-a").await;
        assert_eq!(scene, hash);
        servers.used(&scene, NOW - KEEP.as_secs()).await;
        let came = Arc::new(Mutex::new(None));
        let (noted, first) = (came.clone(), what == "list");
        let job = move |servers: &[Arc<Told>]| {
            *noted.lock().unwrap() = Some(Servers::used_and_there(servers, &hash));
            Ok(())
        };
        if first {
            // the listing after the manifest has gone
            let servers_then = servers.0.clone();
            let job = Arc::new(job);
            servers.once("delete", object_key(&hash), move |_| {
                let (all, job) = (Servers(servers_then.clone()), job.clone());
                all.once("list", "uses/".to_owned(), move |servers| job(servers));
                Ok(())
            });
        } else {
            servers.once(what, key.clone(), job);
        }
        let swept = servers.sweep(NOW, &[]).await.unwrap();
        let there = came.lock().unwrap().unwrap_or_else(|| panic!("{what} {key}: nothing of that kind was called"));
        assert_eq!(there, found, "{what} {key}");
        if there {
            assert_eq!(swept, Swept::default(), "{what} {key}");
            assert!(servers.whole(&scene).await, "{what} {key}");
        } else {
            // prepared again, whatever was left
            servers.prepare(&made, &made.manifest, "scene-a").await;
        }
        assert!(!servers.keys().await.iter().any(|key| key.starts_with("going/")));
        assert_eq!(servers.sweep(NOW + 2, &[]).await.unwrap(), Swept::default());
        assert!(servers.whole(&scene).await, "{what} {key}");
    }
}

/// Another operator's job of the same scene with another size, just then.
#[tokio::test]
async fn a_scene_of_the_same_objects_that_is_made_meanwhile_keeps_them() {
    let made = Made::new(3);
    let again = made.for_spp(9);
    let (first, second) = (made.manifest.reference().hash, again.reference().hash);
    for (what, key) in [("delete", "names/".to_owned()), ("delete", object_key(&first))] {
        let servers = Servers::new(3);
        servers.prepare(&made, &made.manifest, "scene-a").await;
        servers.used(&first, NOW - KEEP.as_secs()).await;
        let body = again.encode();
        servers.once(what, key, move |servers| {
            let name = serde_json::to_vec(&ObjectRef::of(&body)).unwrap();
            for server in &servers[1..] {
                server.inner.put(&object_key(&second), body.clone().into()).now_or_never().unwrap()?;
                server.inner.put("names/scene-b", name.clone().into()).now_or_never().unwrap()?;
            }
            assert!(Servers::used_and_there(servers, &second));
            Ok(())
        });
        assert_eq!(servers.sweep(NOW, &[]).await.unwrap(), Swept { scenes: 1, objects: 0, bytes: 0 });
        assert!(servers.whole(&second).await);
    }
}

#[tokio::test]
async fn a_deletion_that_was_cut_off_is_gone_on_with() {
    let made = Made::new(3);
    let hash = made.manifest.reference().hash;
    for key in [object_key(&hash), world(&made), format!("uses/{hash}")] {
        let servers = Servers::new(3);
        servers.prepare(&made, &made.manifest, "scene-a").await;
        servers.used(&hash, NOW - KEEP.as_secs()).await;
        servers.once("delete", key.clone(), |_| Err(away("delete")));
        assert!(servers.sweep(NOW, &[]).await.is_err());
        servers.sweep(NOW, &[]).await.unwrap();
        assert_eq!(servers.keys().await, [""; 0], "{key}");
        // prepared again before that: it stays
        servers.prepare(&made, &made.manifest, "scene-a").await;
        servers.used(&hash, NOW - KEEP.as_secs()).await;
        servers.once("delete", key.clone(), |_| Err(away("delete")));
        assert!(servers.sweep(NOW, &[]).await.is_err());
        servers.prepare(&made, &made.manifest, "scene-a").await;
        servers.used(&hash, NOW).await;
        assert_eq!(servers.sweep(NOW, &[]).await.unwrap(), Swept::default());
        assert!(servers.whole(&hash).await, "{key}");
        assert!(!servers.keys().await.iter().any(|key| key.starts_with("going/")), "{key}");
    }
}

#[tokio::test]
async fn nothing_goes_while_a_server_is_away_or_a_job_looks_or_a_list_cannot_be_read() {
    let (made, other) = (Made::new(3), Made::new(5));
    let servers = Servers::new(3);
    let scene = servers.prepare(&made, &made.manifest, "scene-a").await;
    let used = servers.prepare(&other, &other.manifest, "scene-b").await;
    servers.used(&scene, NOW - KEEP.as_secs()).await;
    servers.used(&used, NOW).await;
    // one that was away has an old mark of the scene in use
    let old = serde_json::to_vec(&Mark { time: 1, stores: 3 }).unwrap();
    servers.0[2].inner.put(&format!("uses/{used}"), old.into()).await.unwrap();
    let before = servers.keys().await;
    let none: BTreeSet<ObjectHash> = BTreeSet::new();
    let rules = Rules { now: NOW, keep: KEEP, used: &none };
    assert_eq!(sweep(&servers.stores(), &rules, || None::<()>).await.unwrap(), Swept::default());
    servers.once("list", "names/".to_owned(), |_| Err(away("list")));
    assert!(servers.sweep(NOW, &[]).await.is_err());
    // nobody knows which objects the scene in use has
    let key = object_key(&used);
    for server in [1, 2] {
        servers.0[server].inner.put(&key, Bytes::from_static(b"broken")).await.unwrap();
    }
    assert!(servers.sweep(NOW, &[]).await.unwrap_err().to_string().contains("its bytes hash to"));
    assert_eq!(servers.keys().await, before);
    // nor has anybody used it since: it is forgotten, and what was its alone is left to gc
    servers.used(&used, NOW - KEEP.as_secs()).await;
    assert_eq!(servers.sweep(NOW, &[]).await.unwrap().scenes, 2);
    let left = servers.keys().await;
    assert!(!left.is_empty() && left.iter().all(|key| key.starts_with("objects/")), "{left:?}");
    let done = collect(&servers.stores()).await.unwrap();
    assert_eq!((done.objects, done.kept), (left.len() as u64, 0));
    assert_eq!(servers.keys().await, [""; 0]);
}

#[tokio::test]
async fn what_one_of_several_servers_holds_may_be_named_on_another() {
    let made = Made::new(3);
    let servers = Servers::new(3);
    let scene = servers.prepare(&made, &made.manifest, "scene-a").await;
    let stray = ObjectHash::of(b"stray");
    for server in &servers.0 {
        server.inner.put(&object_key(&stray), Bytes::from_static(b"stray")).await.unwrap();
    }
    // no key of ours
    servers.0[0].inner.put("objects/readme", Bytes::new()).await.unwrap();
    let before = servers.keys().await.len();
    servers.used(&scene, NOW).await;
    for one in servers.stores().chunks(1).chain(servers.stores().chunks(2)).filter(|s| s.len() < 3) {
        let error = collect(one).await.unwrap_err();
        assert!(matches!(error, JobError::Settings(_)) && error.to_string().contains("one of 3"), "{error}");
    }
    assert_eq!(servers.keys().await.len(), before + 3);
    let done = collect(&servers.stores()).await.unwrap();
    assert_eq!((done.objects, done.bytes), (3, 15));
    assert_eq!(servers.keys().await.len(), before);
    assert!(servers.whole(&scene).await);
    // a scene of a version without marks says it by its homes
    let server = Servers::new(1);
    let with_homes = Manifest { homes: Some(vec![1]), ..made.manifest.clone() };
    server.prepare(&made, &with_homes, "scene-a").await;
    assert!(collect(&server.stores()).await.unwrap_err().to_string().contains("one of 2 or more"));
    // nor is a scene given up whose manifest is broken
    let key = object_key(&with_homes.reference().hash);
    server.0[0].inner.put(&key, Bytes::from_static(b"broken")).await.unwrap();
    let error = collect(&server.stores()).await.unwrap_err().to_string();
    assert!(error.contains("names/scene-a") && error.contains("delete it to give the scene up"), "{error}");
}

#[tokio::test]
async fn marks_are_on_every_server_that_takes_them() {
    let servers = Servers::new(3);
    let scene = ObjectHash::of(b"any");
    servers.once("put", "uses/".to_owned(), |_| Err(away("put")));
    mark(&servers.stores(), &scene, NOW).await.unwrap();
    assert_eq!(servers.keys().await.len(), 2);
    let found = find(&servers.stores()).await.unwrap();
    assert_eq!((found.stores, found.all[&scene].used), (3, Some(NOW)));
}
