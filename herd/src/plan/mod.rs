//! Which task runs where, with what. Pure: a function of what waits, who is free and what is warm.
//!
//! The planner minimises bytes moved, then time: a split goes where it is warm, else where a copy lies on disk, else
//! to any free slot. The paper's strategies take the splits with most rays, one a slot; `auto` cuts the scene into windows
//! of neighbouring splits and keeps them warm.

mod auto;
pub mod cost;
pub mod cut;
mod grid;
mod moving;
pub mod place;
mod queues;
pub mod rate;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};

pub use rayherd_api::Strategy;
use serde::{Deserialize, Serialize};

/// A split, as the planner sees it.
#[derive(Clone, Debug)]
pub struct SplitView {
    /// Memory that it takes.
    pub bytes: u64,
    /// Nodes with a copy on disk.
    pub holders: Vec<u32>,
}

/// A node, as the planner sees it.
#[derive(Clone, Debug)]
pub struct NodeView {
    /// Its slots; 0 for a node that is gone.
    pub slots: u32,
    /// Slots without a task.
    pub free: u32,
    /// Scene data that it may hold in memory, bytes.
    pub memory: u64,
    /// Splits that it holds in memory, or will for the tasks it runs.
    pub warm: BTreeSet<u32>,
}

/// A ray group that waits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Waiting {
    /// What the caller calls it.
    pub id: usize,
    /// Rays in it.
    pub rays: u64,
}

/// Splits that a task of `auto` holds together, ascending, in the order of [`place::order`].
pub type Window = Vec<u32>;

/// All that a plan depends on.
#[derive(Clone, Debug)]
pub struct View<'a> {
    /// Which way of planning.
    pub strategy: Strategy,
    /// All splits, in the order of [`place::order`] (neighbours in space are neighbours here).
    pub splits: &'a [SplitView],
    /// All nodes.
    pub nodes: &'a [NodeView],
    /// Groups by split.
    pub waiting: BTreeMap<u32, Vec<Waiting>>,
    /// Groups that wait for a reduce step.
    pub reduce: Vec<Waiting>,
    /// Camera rays still to be made, by the split where they start.
    pub camera: BTreeMap<u32, u64>,
    /// Most rays that a task takes from groups.
    pub task_rays: u64,
    /// Most camera rays that a task makes.
    pub task_camera: u64,
    /// Fewer rays are not worth a task while others run.
    pub least_rays: u64,
    /// Copies of each object.
    pub replicas: u32,
    /// Scene data that one task can hold, bytes.
    pub forest: u64,
    /// For `auto`: windows that cover the splits, as [`cut::choose`] made them; none where they move.
    pub cut: &'a [Window],
    /// What rays did so far.
    pub traffic: cost::Traffic,
}

impl View<'_> {
    /// Slots of a node, at least 1 so that it can divide.
    fn slots(&self, node: u32) -> f64 {
        f64::from(self.nodes[node as usize].slots.max(1))
    }
}

/// The data that a task works with.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Set {
    /// These splits, all at once.
    Resident(Vec<u32>),
    /// Any split, one after the other, through the node's memory.
    Any,
    /// This split and then those that share a cell with it, one after the other.
    Sharing(u32),
    /// None: candidates are merged.
    Reduce,
}

/// One task to start.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Assignment {
    /// Where.
    pub node: u32,
    /// With what data.
    pub set: Set,
    /// Groups to consume, by the caller's numbers.
    pub groups: Vec<usize>,
    /// About how many camera rays to make, and of which start splits (none: of any).
    pub camera: Option<(u64, Vec<u32>)>,
}

/// Tasks to start now; none if it is better to wait for those that run, or if there is nothing to do.
///
/// Whatever waits gets its turn: when no task runs and something waits, there is at least one assignment.
pub fn plan(view: &View) -> Vec<Assignment> {
    if view.nodes.iter().all(|n| n.free == 0) {
        return Vec::new();
    }
    match view.strategy {
        Strategy::DemandDriven => demand_driven(view),
        Strategy::SchedulingGrid | Strategy::SchedulingGridOverlapReduced => grid::plan(view),
        Strategy::Auto if view.cut.is_empty() => moving::plan(view),
        Strategy::Auto => auto::plan(view),
    }
}

/// Rays dealt evenly to the free slots, whatever they need.
fn demand_driven(view: &View) -> Vec<Assignment> {
    let mut slots = free_slots(view.nodes);
    let mut groups: Vec<Waiting> =
        view.waiting.values().flatten().copied().chain(view.reduce.iter().copied()).collect();
    groups.sort_by_key(|g| (std::cmp::Reverse(g.rays), g.id));
    let total: u64 = groups.iter().map(|g| g.rays).sum();
    let mut out = Vec::new();
    if total > 0 {
        let share = total.div_ceil(slots.len() as u64).min(view.task_rays);
        let mut groups = groups.into_iter().peekable();
        while let (Some(node), true) = (slots.pop(), groups.peek().is_some()) {
            let groups = take(&mut groups, share);
            out.push(Assignment { node, set: Set::Any, groups, camera: None });
        }
        return out;
    }
    deal_camera(view, &mut slots, Set::Any)
}

/// Splits the camera rays evenly over the free slots.
fn deal_camera(view: &View, slots: &mut Vec<u32>, set: Set) -> Vec<Assignment> {
    let mut left: u64 = view.camera.values().sum();
    let all: u64 = view.nodes.iter().map(|n| u64::from(n.slots)).sum();
    let share = left.div_ceil(all.max(1)).clamp(1, view.task_camera.max(1));
    let mut out = Vec::new();
    while left > 0
        && let Some(node) = slots.pop()
    {
        out.push(Assignment { node, set: set.clone(), groups: vec![], camera: Some((share, vec![])) });
        left = left.saturating_sub(share);
    }
    out
}

/// Free slots as node numbers, so that popping takes nodes in turn.
fn free_slots(nodes: &[NodeView]) -> Vec<u32> {
    let most = nodes.iter().map(|n| n.free).max().unwrap_or(0);
    let mut slots = Vec::new();
    for k in 0..most {
        slots.extend((0..nodes.len() as u32).filter(|&n| nodes[n as usize].free > k));
    }
    slots.reverse();
    slots
}

/// Takes groups until there are `rays` of them, at least one.
fn take(groups: &mut impl Iterator<Item = Waiting>, rays: u64) -> Vec<usize> {
    let mut out = Vec::new();
    let mut sum = 0;
    while sum < rays.max(1)
        && let Some(g) = groups.next()
    {
        sum += g.rays;
        out.push(g.id);
    }
    out
}
