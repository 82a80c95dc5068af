//! Prepared scenes that no job names, and that none has used for long, go, and objects that belong to no scene, as a preparing that was killed leaves
//! them: the leader looks at long intervals. Such an object goes when it is found so twice.
//!
//! Looked at is each storage that a job names or has used since this operator began to lead: it has no keys to others. The API server is asked
//! for the jobs, and told nothing.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use kube::Api;
use kube::api::{ApiResource, DynamicObject, ListParams};
use rayherd_api::StorageSpec;
use rayherd_api::resource::RenderJobObject;
use rayherd_herd::remote::{Depot, Storage};
use rayherd_herd::scenes::{Rules, Swept, collect_again, sweep, unix_now};
use rayherd_scene::objects::ObjectHash;
use serde_json::Value;

use crate::backoff::part;
use crate::reconcile::Context;
use crate::storage;

/// Before the first look, at most: jobs that were begun before this operator led are begun here by then.
const FIRST: Duration = Duration::from_secs(1800);
/// Between two looks, at most.
const EVERY: Duration = Duration::from_secs(6 * 3600);
/// Seconds of a day.
const DAY: u64 = 86_400;

/// Storages that jobs have used.
#[derive(Default)]
pub struct Storages(Mutex<Vec<Known>>);

#[derive(Clone)]
struct Known {
    storage: Storage,
    depot: Depot,
    /// What belonged to no scene when it was looked last.
    strays: BTreeSet<ObjectHash>,
}

impl Storages {
    fn lock(&self) -> MutexGuard<'_, Vec<Known>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes a storage, with the newest keys to it.
    pub fn add(&self, storage: &Storage, depot: &Depot) {
        let same = |other: &Storage| {
            let servers = |s: &Storage| s.endpoints.iter().map(|e| e.url.clone()).collect::<Vec<_>>();
            (&other.bucket, &other.prefix) == (&storage.bucket, &storage.prefix) && servers(other) == servers(storage)
        };
        let mut all = self.lock();
        let strays =
            all.iter_mut().find(|k| same(&k.storage)).map(|k| std::mem::take(&mut k.strays)).unwrap_or_default();
        all.retain(|k| !same(&k.storage));
        all.push(Known { storage: storage.clone(), depot: depot.clone(), strays });
    }

    fn found(&self, storage: &Storage, strays: BTreeSet<ObjectHash>) {
        if let Some(known) = self.lock().iter_mut().find(|k| k.storage == *storage) {
            known.strays = strays;
        }
    }
}

/// Looks again and again, as long as the process lives; not at all where scenes are kept for ever.
pub async fn keep(context: Arc<Context>) {
    if context.config.scene_days == 0 {
        return;
    }
    let who = &context.config.pod;
    tokio::time::sleep(part(FIRST, who, 0)).await;
    for round in 1.. {
        look(&context, unix_now()).await;
        tokio::time::sleep(part(EVERY, who, round)).await;
    }
}

/// Looks once, at a time in seconds since 1970; what went.
pub async fn look(context: &Context, now: u64) -> Swept {
    let mut swept = Swept::default();
    // as they are, so that one that cannot be read keeps its scene too
    let kind = ApiResource::erase::<RenderJobObject>(&());
    let jobs: Api<DynamicObject> = match &context.config.watch {
        Some(namespace) => Api::namespaced_with(context.client.clone(), namespace, &kind),
        None => Api::all_with(context.client.clone(), &kind),
    };
    let jobs = match jobs.list(&ListParams::default()).await {
        Ok(jobs) => jobs.items,
        Err(e) => {
            tracing::warn!("it is not looked for scenes that nobody uses: cannot list the jobs: {e}");
            return swept;
        }
    };
    let told = |v: &Value| v.as_str().and_then(|hash| hash.parse::<ObjectHash>().ok());
    let named = jobs.iter().flat_map(|j| [&j.data["status"]["scene"], &j.data["spec"]["scene"]["prepared"]]);
    let running = context.jobs.all();
    let running = running.iter().filter_map(|r| r.lock().scene.as_deref().and_then(|hash| hash.parse().ok()));
    let used: BTreeSet<ObjectHash> = named.filter_map(told).chain(running).collect();
    let storages: BTreeMap<(String, String), StorageSpec> = jobs
        .iter()
        .filter_map(|job| {
            let storage = &job.data["spec"]["storage"];
            let spec = if storage.is_null() {
                Some(StorageSpec::default())
            } else {
                serde_json::from_value(storage.clone()).ok()
            };
            Some(((job.metadata.namespace.clone()?, storage.to_string()), spec?))
        })
        .collect();
    for ((namespace, _), spec) in &storages {
        match found(context, namespace, spec).await {
            Ok((storage, depot)) => context.storages.add(&storage, &depot),
            Err(why) => tracing::debug!("it is not looked for scenes that nobody uses: {why}"),
        }
    }
    let keep = Duration::from_secs(u64::from(context.config.scene_days) * DAY);
    let known = context.storages.lock().clone();
    for Known { storage, depot, strays } in known {
        let rules = Rules { now, keep, used: &used };
        match sweep(depot.stores(), &rules, || context.turns.alone()).await {
            Ok(gone) => {
                if gone != Swept::default() {
                    let Swept { scenes, objects, bytes } = gone;
                    tracing::info!(scenes, objects, bytes, "prepared scenes that nobody has used for long are deleted");
                }
                context.metrics.scenes_deleted.inc_by(gone.scenes);
                swept.scenes += gone.scenes;
                swept.objects += gone.objects;
                swept.bytes += gone.bytes;
            }
            Err(e) => tracing::warn!("scenes that nobody uses stay for now: {e}"),
        }
        // nor while a job looks for its scene, or has it prepared: what is made for it has no name yet
        let Some(_alone) = context.turns.alone() else { continue };
        match collect_again(depot.stores(), &strays).await {
            Ok((gone, left)) => {
                if gone.objects > 0 {
                    let (objects, bytes) = (gone.objects, gone.bytes);
                    tracing::info!(objects, bytes, "objects that belong to no scene are deleted");
                }
                swept.objects += gone.objects;
                swept.bytes += gone.bytes;
                context.storages.found(&storage, left);
            }
            Err(e) => tracing::warn!("objects that belong to no scene stay for now: {e}"),
        }
    }
    swept
}

async fn found(context: &Context, namespace: &str, spec: &StorageSpec) -> Result<(Storage, Depot), String> {
    let told = |e: storage::StorageError| e.to_string();
    let found = storage::storage(&context.client, &context.config.namespace, spec).await.map_err(told)?;
    let credentials = storage::credentials(&context.client, namespace, spec, &found).await.map_err(told)?;
    let depot = found.depot(None, &credentials).map_err(|e| e.to_string())?;
    Ok((found, depot))
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use rayherd_herd::scenes::{find, mark};
    use rayherd_herd::store::{BlockStore, MemoryStore, object_key};
    use rayherd_scene::objects::ObjectRef;
    use serde_json::json;

    use super::*;
    use crate::tests::{PROFILE, context, job, not_found, serve, step};

    const NOW: u64 = 1_800_000_000;
    const JOBS: &str = "/apis/rayherd.io/v1alpha1/renderjobs?";

    /// A storage whose scenes were all used so many days ago.
    async fn storage(scenes: &[ObjectRef], days: u64) -> (Arc<dyn BlockStore>, Depot) {
        let store: Arc<dyn BlockStore> = Arc::new(MemoryStore::default());
        for scene in scenes {
            let name = serde_json::to_vec(scene).unwrap();
            store.put(&format!("names/scene-{}", scene.bytes), name.into()).await.unwrap();
            mark(std::slice::from_ref(&store), &scene.hash, NOW - days * DAY).await.unwrap();
        }
        let depot = Depot::new(vec![store.clone()], None).unwrap();
        (store, depot)
    }

    #[tokio::test]
    async fn what_no_job_names_goes_and_the_api_server_is_only_asked() {
        let [unused, named, of_unreadable, given] = [&b"1"[..], b"22", b"333", b"4444"].map(ObjectRef::of);
        let all = [unused, named, of_unreadable, given];
        let (context, server) = context();
        let (store, depot) = storage(&all, 30).await;
        // one that was made by a version that nobody reads any more
        store.put(&object_key(&unused.hash), Bytes::from_static(b"1")).await.unwrap();
        let place = Storage { bucket: "b".into(), ..Storage::default() };
        context.storages.add(&place, &depot);
        // a day later, and with newer keys, it is the same one
        context.storages.add(&place, &depot);
        assert_eq!(context.storages.lock().len(), 1);
        let with = |scene: Value, spp: u64, status: Value| {
            let mut job = job();
            (job["spec"]["scene"], job["spec"]["sampling"], job["status"]) = (scene, json!({"spp": spp}), status);
            job
        };
        let jobs = [
            with(json!({"source": "a.xml"}), 1, json!({"scene": named.hash.to_string()})),
            with(json!({"source": "a.xml"}), u64::MAX, json!({"scene": of_unreadable.hash.to_string()})),
            with(json!({"prepared": given.hash.to_string()}), 1, json!({})),
        ];
        let list = json!({"apiVersion": "rayherd.io/v1alpha1", "kind": "RenderJobList", "metadata": {}, "items": jobs});
        // of the jobs' own storage there is no profile: only the other one is looked at
        let asked = || vec![step("GET", JOBS, 200, list.clone()), step("GET", PROFILE, 404, not_found())];
        let (swept, _) = tokio::join!(look(&context, NOW), serve(server, asked()));
        assert_eq!(swept.scenes, 1);
        assert_eq!(context.metrics.scenes_deleted.get(), 1);
        let found = find(depot.stores()).await.unwrap();
        let left: Vec<(ObjectHash, Option<u64>)> = found.all.iter().map(|(hash, s)| (*hash, s.used)).collect();
        let mut want = [named, of_unreadable, given].map(|s| (s.hash, Some(NOW)));
        want.sort_unstable();
        assert_eq!(left, want);
    }

    #[tokio::test]
    async fn nothing_goes_where_nobody_says_what_is_used_or_a_job_looks_for_its_scene() {
        let unused = ObjectRef::of(b"1");
        let none = json!({"apiVersion": "rayherd.io/v1alpha1", "kind": "RenderJobList", "metadata": {}, "items": []});
        for (status, looking, gone) in [(500, false, 0), (200, true, 0), (200, false, 1)] {
            let (context, server) = context();
            let (_, depot) = storage(&[unused], 31).await;
            context.storages.add(&Storage::default(), &depot);
            let turns = context.turns.clone();
            let look_of_job = looking.then(|| turns.look(|| Ok(())).unwrap());
            let (swept, _) =
                tokio::join!(look(&context, NOW), serve(server, vec![step("GET", JOBS, status, none.clone())]));
            drop(look_of_job);
            assert_eq!(swept.scenes, gone, "{status} {looking}");
        }
    }

    /// What a preparing that was killed has left: not the first time, when somebody may be at it, nor while a job looks.
    #[tokio::test]
    async fn what_belongs_to_no_scene_goes_when_it_is_found_so_twice() {
        let (context, server) = context();
        let (store, depot) = storage(&[], 0).await;
        context.storages.add(&Storage::default(), &depot);
        let stray = |body: &'static [u8]| {
            let store = store.clone();
            async move {
                let key = object_key(&ObjectRef::of(body).hash);
                store.put(&key, Bytes::from_static(body)).await.unwrap();
            }
        };
        let left = || async { store.list("objects/").await.unwrap().len() };
        let none = json!({"apiVersion": "rayherd.io/v1alpha1", "kind": "RenderJobList", "metadata": {}, "items": []});
        let turns = context.turns.clone();
        let looks = async {
            stray(b"1").await;
            look(&context, NOW).await;
            assert_eq!(left().await, 1);
            let of_job = turns.look(|| Ok(())).unwrap();
            look(&context, NOW).await;
            assert_eq!(left().await, 1);
            drop(of_job);
            stray(b"22").await;
            // with newer keys it is the same storage
            context.storages.add(&Storage::default(), &depot);
            let swept = look(&context, NOW).await;
            assert_eq!((left().await, swept.objects, swept.bytes), (1, 1, 1));
            assert_eq!(look(&context, NOW).await.objects, 1);
        };
        tokio::join!(looks, serve(server, (0..4).map(|_| step("GET", JOBS, 200, none.clone())).collect()));
        assert_eq!(left().await, 0);
    }
}
