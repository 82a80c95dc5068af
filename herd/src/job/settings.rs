//! How a job is to be run, and which image it is to make.

use std::fmt;
use std::num::NonZeroU32;
use std::sync::Arc;

use rayherd_api::Strategy;
use rayherd_render::bvh::Kernel;

use crate::local::faults::Faults;
use crate::store::BlockStore;
use crate::textures::DEFAULT_BUDGET;

/// One node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NodeSpec {
    /// Tasks that it runs at once.
    pub slots: u32,
}

/// Where a job keeps its commits, so that it can go on after a crash, or with more samples.
#[derive(Clone)]
pub struct Commits {
    /// The store; one job's.
    pub store: Arc<dyn BlockStore>,
    /// Goes on where the store's records end; without it a store with records is refused.
    pub resume: bool,
    /// Takes the store from whoever writes to it.
    pub takeover: bool,
}

impl fmt::Debug for Commits {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Commits { store, resume, takeover } = self;
        write!(f, "Commits {{ {}, resume: {resume}, takeover: {takeover} }}", store.describe())
    }
}

/// How a job runs. None of it touches a byte of the image.
#[derive(Clone, Debug)]
pub struct JobSettings {
    /// Which data a task holds and which rays it gets.
    pub strategy: Strategy,
    /// At least one node with at least one slot.
    pub nodes: Vec<NodeSpec>,
    /// Scene data (geometry and attributes) that a node may hold in memory, bytes; all of it if none.
    pub memory_per_node: Option<u64>,
    /// Bytes of texture tiles that a node keeps in memory beside its scene data.
    pub texture_memory: u64,
    /// Copies of each object, on as many nodes.
    pub replicas: u32,
    /// Whether a round ends before the next begins; the strategy's own way if none (`auto`: off, others: on).
    pub barrier: Option<bool>,
    /// Size of a task, seconds of one slot.
    pub task_seconds: f64,
    /// Threads that compute at once, whatever the slots; as many as the machine has if none.
    pub threads: Option<NonZeroU32>,
    /// Which code traces.
    pub kernel: Kernel,
    /// Rays that are traced together.
    pub batch: u32,
    /// Bytes of rays that a task holds before it puts some of them into a group.
    pub ray_buffer: u64,
    /// A task that runs longer than this gets a second attempt when slots are idle; three times the size of a task, at least
    /// a second, if none.
    pub straggler_seconds: Option<f64>,
    /// Where commits are kept; nowhere if none.
    pub commits: Option<Commits>,
    /// Whether the report says what each stage of the tasks cost.
    pub profile: bool,
    /// Faults to inject, for tests.
    pub faults: Option<Faults>,
}

impl Default for JobSettings {
    /// One node with a slot per hardware thread and no bound on memory.
    fn default() -> Self {
        let threads = std::thread::available_parallelism().map_or(1, |n| n.get() as u32);
        JobSettings {
            strategy: Strategy::Auto,
            nodes: vec![NodeSpec { slots: threads }],
            memory_per_node: None,
            texture_memory: DEFAULT_BUDGET,
            replicas: 1,
            barrier: None,
            task_seconds: 10.0,
            threads: None,
            kernel: Kernel::Auto,
            batch: 16_384,
            ray_buffer: 64 << 20,
            straggler_seconds: None,
            commits: None,
            profile: false,
            faults: None,
        }
    }
}

impl JobSettings {
    /// Slots of all nodes.
    pub fn slots(&self) -> u32 {
        self.nodes.iter().map(|n| n.slots).sum()
    }
    /// Whether rounds have a barrier.
    pub fn has_barrier(&self) -> bool {
        self.barrier.unwrap_or(self.strategy != Strategy::Auto)
    }
}

/// Which samples are taken, and when to stop.
#[derive(Clone, Debug, PartialEq)]
pub struct Sampling {
    /// Most samples per pixel, at most 2^24: on average, where they are shared out for a target error ([`crate::allot`]).
    pub spp: u32,
    /// Stop at the first part of a step (see [`crate::wave`]) where the estimated relMSE is at most this.
    pub target_error: Option<f64>,
    /// Start no step of the schedule after so many seconds.
    pub time_limit: Option<f64>,
}
