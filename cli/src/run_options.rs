//! Flags that say how a job runs. None of them touches a byte of the image.

use std::num::NonZeroU32;

use clap::Args;
use rayherd_api::{ByteSize, RenderJobSpec, Strategy};
use rayherd_herd::job::{JobSettings, NodeSpec};
use rayherd_render::bvh::Kernel;

use crate::fault::Mistake;
use crate::options::set;

/// How a job runs.
#[derive(Args, Default)]
#[command(next_help_heading = "Running (the image is the same bytes for all of these)")]
pub struct RunOptions {
    /// How rays and scene data meet: demand-driven, scheduling-grid, scheduling-grid-overlap-reduced or auto
    /// [default: auto]
    #[arg(long, value_name = "NAME")]
    pub strategy: Option<Strategy>,
    /// Number of virtual nodes [default: 1, or as many as --slots has numbers]
    #[arg(long, value_name = "N", allow_hyphen_values = true)]
    pub nodes: Option<i32>,
    /// Tasks at a time: one number for all nodes, or one for each, such as 2,2,4,4 [default: this machine's threads]
    #[arg(long, value_name = "S", value_delimiter = ',', allow_hyphen_values = true)]
    pub slots: Vec<i32>,
    /// Scene data that a node may hold in memory, such as 512Mi; rays, film and the one object that is being loaded come
    /// on top, bounded apart from it
    /// [default: no limit]
    #[arg(long, value_name = "PER_NODE")]
    pub memory: Option<ByteSize>,
    /// Nodes that hold a copy of each object [default: 1]
    #[arg(long, value_name = "R", allow_hyphen_values = true)]
    pub replicas: Option<i32>,
    /// Whether a round ends before the next begins [default: off for auto, on for the others]
    #[arg(long, value_name = "on|off", value_parser = on_off)]
    pub barrier: Option<bool>,
    /// Work that a task is sized to, seconds [default: 10]
    #[arg(long, value_name = "S", allow_hyphen_values = true)]
    pub task_seconds: Option<f64>,
    /// Threads that compute at a time, whatever the slots [default: this machine's]
    #[arg(long, value_name = "N")]
    pub threads: Option<NonZeroU32>,
    /// Code that traces rays: auto, scalar, avx2 or avx512 [default: auto]
    #[arg(long, value_name = "NAME", value_parser = kernel)]
    pub kernel: Option<Kernel>,
}

impl RunOptions {
    /// Sets what was given, but threads and kernel, which belong to this machine and not to the job.
    pub fn apply(&self, spec: &mut RenderJobSpec) {
        spec.strategy = self.strategy.unwrap_or(spec.strategy);
        if self.nodes.is_some() || !self.slots.is_empty() {
            // nodes and slots say one thing together: a flag for one makes the file's other void
            spec.workers.nodes = self.nodes;
            spec.workers.slots.clone_from(&self.slots);
        }
        set(&mut spec.workers.memory, self.memory);
        set(&mut spec.replicas, self.replicas);
        set(&mut spec.barrier, self.barrier);
        set(&mut spec.task_seconds, self.task_seconds);
    }

    /// What the local run is told by a job that was checked.
    pub fn settings(&self, spec: &RenderJobSpec) -> Result<JobSettings, Mistake> {
        let defaults = JobSettings::default();
        let threads = self.threads.map_or(defaults.nodes[0].slots, NonZeroU32::get);
        let slots = spec.workers.slots_per_node(threads);
        let slots = slots.ok_or_else(|| Mistake("--nodes and --slots contradict each other".into()))?;
        Ok(JobSettings {
            strategy: spec.strategy,
            nodes: slots.into_iter().map(|slots| NodeSpec { slots }).collect(),
            memory_per_node: spec.workers.memory.map(ByteSize::bytes),
            replicas: spec.replicas.map_or(defaults.replicas, |r| r as u32),
            barrier: spec.barrier,
            task_seconds: spec.task_seconds.unwrap_or(defaults.task_seconds),
            threads: self.threads,
            kernel: self.kernel.unwrap_or_default(),
            ..defaults
        })
    }
}

fn on_off(text: &str) -> Result<bool, &'static str> {
    match text {
        "on" => Ok(true),
        "off" => Ok(false),
        _ => Err("write on or off"),
    }
}

fn kernel(text: &str) -> Result<Kernel, &'static str> {
    match text {
        "auto" => Ok(Kernel::Auto),
        "scalar" => Ok(Kernel::Scalar),
        "avx2" => Ok(Kernel::Avx2),
        "avx512" => Ok(Kernel::Avx512),
        _ => Err("choose auto, scalar, avx2 or avx512"),
    }
}
