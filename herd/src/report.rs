//! What a run says about itself: stable keys, so that scripts can read them.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::profile::Profile;

/// When bytes moved.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Stage {
    /// Preparing the scene, placing its blocks on nodes.
    Prepare,
    /// Tracing.
    Trace,
}

/// Which way bytes moved.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Op {
    /// Out of a store or cache.
    Read,
    /// Into a store.
    Write,
}

/// What the bytes were.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// The scene's source files.
    Source,
    /// The stream of primitives between the passes of preparing.
    Spool,
    /// Manifest, grid, world.
    Manifest,
    /// Built blocks of splits.
    Geometry,
    /// Shading attributes of splits.
    Attributes,
    /// Texture tiles.
    Texture,
    /// Ray groups.
    Rays,
    /// Film parts, round records.
    Film,
}

/// Where the bytes were, seen from the node that asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Place {
    /// In its memory.
    Cache,
    /// On its own disk.
    Local,
    /// On another node.
    Remote,
}

/// One row of the byte counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct BytesRow {
    /// When.
    pub stage: Stage,
    /// Which way.
    pub op: Op,
    /// What.
    pub kind: Kind,
    /// Where.
    pub place: Place,
    /// How many.
    pub bytes: u64,
}

/// Byte counts by (stage, op, kind, place).
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Bytes(BTreeMap<(Stage, Op, Kind, Place), u64>);

impl Bytes {
    /// Counts `bytes` more.
    pub fn add(&mut self, stage: Stage, op: Op, kind: Kind, place: Place, bytes: u64) {
        if bytes > 0 {
            *self.0.entry((stage, op, kind, place)).or_default() += bytes;
        }
    }
    /// Adds all of another.
    pub fn merge(&mut self, other: &Bytes) {
        for (k, v) in &other.0 {
            *self.0.entry(*k).or_default() += v;
        }
    }
    /// Sum over the rows that the predicate takes.
    pub fn sum(&self, take: impl Fn(Stage, Op, Kind, Place) -> bool) -> u64 {
        self.0.iter().filter(|((s, o, k, p), _)| take(*s, *o, *k, *p)).map(|(_, v)| v).sum()
    }
    /// The rows that are not zero, in a fixed order.
    pub fn rows(&self) -> Vec<BytesRow> {
        self.0.iter().map(|(&(stage, op, kind, place), &bytes)| BytesRow { stage, op, kind, place, bytes }).collect()
    }
}

/// Rays by what they asked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RayCounts {
    /// Camera rays (they are closest-hit rays too).
    pub camera: u64,
    /// Paths' closest-hit rays, camera rays included, each once however many splits it visited.
    pub closest: u64,
    /// Shadow rays, each once however many splits it visited.
    pub shadow: u64,
    /// Camera rays that were not traced because a sibling's ray of the same pixel had the same origin and direction.
    pub merged: u64,
}

impl RayCounts {
    /// Adds all of another.
    pub fn merge(&mut self, o: &RayCounts) {
        self.camera += o.camera;
        self.closest += o.closest;
        self.shadow += o.shadow;
        self.merged += o.merged;
    }
}

/// What one node did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct NodeReport {
    /// Its slots.
    pub slots: u32,
    /// CPU-seconds of its tasks.
    pub busy: f64,
    /// Bytes it read, from its disk and from other nodes.
    pub reads: u64,
    /// Those of them that came from other nodes.
    pub remote_reads: u64,
    /// The most bytes of scene data that it held in memory at once.
    pub peak_scene_bytes: u64,
    /// The most bytes of texture tiles that it held in memory at once.
    pub peak_texture_bytes: u64,
}

/// One sample of a pixel: what `rayherd replay` takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SampleKey {
    /// Column and row from the upper left corner, from 0.
    pub pixel: [u32; 2],
    /// Index of the sample, from 0.
    pub sample: u32,
}

/// Everything a run says about itself.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// Name of the strategy.
    pub strategy: String,
    /// Nodes.
    pub nodes: u32,
    /// Slots of all nodes.
    pub slots: u32,
    /// Rounds (without a barrier: commits).
    pub rounds: u64,
    /// Tasks committed by this run.
    pub tasks: u64,
    /// Committed tasks that had to be computed again because their outputs were lost.
    pub tasks_redone: u64,
    /// Tasks that an earlier run had committed and that this one took over.
    pub tasks_reused: u64,
    /// Attempts that did not count: lost to faults, or beaten by another attempt.
    pub attempts_lost: u64,
    /// Seconds from start to end.
    pub wall_s: f64,
    /// CPU-seconds of this process.
    pub cpu_s: f64,
    /// Samples per pixel that the image holds: the fewest of a film tile, where they differ.
    pub spp: u32,
    /// The most of a film tile.
    #[serde(default)]
    pub most_spp: u32,
    /// Camera samples that the image holds: the sum over its pixels.
    pub samples: u64,
    /// Rays traced by committed tasks, those of earlier runs that this one took over included.
    pub rays: RayCounts,
    /// Bytes moved.
    pub bytes: Vec<BytesRow>,
    /// Geometry, attributes and textures of the prepared scene, each once, copies by overlap reduction left out.
    pub scene_bytes: u64,
    /// Scene bytes read from disks (own or other) while tracing / `scene_bytes`.
    pub scene_passes: f64,
    /// Of those reads, the part from other nodes; 0 without reads.
    pub remote_ratio: f64,
    /// The same over all reads, rays and film too.
    pub remote_ratio_all: f64,
    /// All bytes between nodes, read and written.
    pub network_bytes: u64,
    /// Rays that left the split set of their task.
    pub hops: u64,
    /// Stored bytes of ray groups, one copy, per hop; none without hops.
    pub bytes_per_hop: Option<f64>,
    /// Most memory that the process held (resident).
    pub peak_memory_bytes: u64,
    /// Bytes written to temporary files because memory's share for them was full: vertex arrays while importing, the prepared
    /// scene, rays and film at rest.
    pub spilled_bytes: u64,
    /// Contributions that were not finite or too large.
    pub non_finite: u64,
    /// The samples of the first of them, by pixel: as many as a film keeps.
    pub non_finite_at: Vec<SampleKey>,
    /// Estimated error of the image, from its halves; none with one sample per pixel.
    pub rel_mse: Option<f64>,
    /// Whether the target error was reached, if one was asked for.
    pub target_reached: Option<bool>,
    /// What preparing said.
    pub prepare: serde_json::Value,
    /// By node.
    pub nodes_detail: Vec<NodeReport>,
    /// Primitives that were skipped, by why.
    pub skipped: BTreeMap<String, u64>,
    /// What was not done because the scene does not need it, by the names of [`rayherd_render::skip::Skip`]: by committed tasks of this run.
    pub skips: BTreeMap<String, u64>,
    /// What each stage of committed tasks of this run cost, if that was asked for.
    #[serde(default)]
    pub profile: Option<Profile>,
}

impl Report {
    /// Notes contributions that were not finite, by pixel number (of a picture of this width) and sample, and tells of them.
    pub fn note_non_finite<'k>(&mut self, width: u32, keys: impl IntoIterator<Item = &'k (u32, u32)>) {
        for &(pixel, sample) in keys {
            let [x, y] = [pixel % width, pixel / width];
            tracing::warn!("pixel {x},{y} sample {sample}: a contribution is not finite or too large");
            self.non_finite_at.push(SampleKey { pixel: [x, y], sample });
        }
    }

    /// Adds what preparing moved before; it belongs to no node, so nothing else follows from it.
    pub fn add_prepare_bytes(&mut self, rows: impl IntoIterator<Item = (Op, Kind, u64)>) {
        let mut all = Bytes::default();
        self.bytes.iter().for_each(|r| all.add(r.stage, r.op, r.kind, r.place, r.bytes));
        rows.into_iter().for_each(|(op, kind, bytes)| all.add(Stage::Prepare, op, kind, Place::Local, bytes));
        self.bytes = all.rows();
    }

    /// Sets `bytes` and what follows from them (DESIGN section 8); `scene_bytes`, `hops` must be set.
    pub fn set_bytes(&mut self, bytes: &Bytes) {
        let scene = |k: Kind| matches!(k, Kind::Geometry | Kind::Attributes | Kind::Texture);
        let read = |s: Stage, o: Op| s == Stage::Trace && o == Op::Read;
        let from = |place: Place, all: bool| bytes.sum(|s, o, k, p| read(s, o) && p == place && (all || scene(k)));
        let ratio =
            |remote: u64, local: u64| if remote + local == 0 { 0.0 } else { remote as f64 / (remote + local) as f64 };
        let (local, remote) = (from(Place::Local, false), from(Place::Remote, false));
        self.scene_passes = if self.scene_bytes == 0 { 0.0 } else { (local + remote) as f64 / self.scene_bytes as f64 };
        self.remote_ratio = ratio(remote, local);
        self.remote_ratio_all = ratio(from(Place::Remote, true), from(Place::Local, true));
        self.network_bytes = bytes.sum(|_, _, _, p| p == Place::Remote);
        self.bytes = bytes.rows();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ratios_count_what_the_design_says() {
        let mut b = Bytes::default();
        b.add(Stage::Trace, Op::Read, Kind::Geometry, Place::Local, 300);
        b.add(Stage::Trace, Op::Read, Kind::Attributes, Place::Remote, 100);
        b.add(Stage::Trace, Op::Read, Kind::Geometry, Place::Cache, 1000);
        b.add(Stage::Trace, Op::Read, Kind::Rays, Place::Remote, 200);
        b.add(Stage::Trace, Op::Write, Kind::Rays, Place::Remote, 50);
        b.add(Stage::Prepare, Op::Read, Kind::Geometry, Place::Remote, 7);
        let mut r = Report { scene_bytes: 200, ..Report::default() };
        r.set_bytes(&b);
        assert_eq!((r.scene_passes, r.remote_ratio, r.remote_ratio_all), (2.0, 0.25, 0.5));
        assert_eq!(r.network_bytes, 357);
        let back: Report = serde_json::from_str(&serde_json::to_string(&r).unwrap()).unwrap();
        assert_eq!(back, r);
    }
}
