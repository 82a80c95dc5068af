//! `auto` where the nodes' memory does not hold the scene: windows that move to the rays.
//!
//! Each node holds a window of neighbouring splits as large as its memory. A node whose window has (nearly) run dry
//! moves to where most rays wait.

use super::queues::{Line, Queues};
use super::{Assignment, NodeView, Set, View, free_slots, place};

/// A window that is left must have this many times fewer rays than the one that is taken up, so that nodes do not
/// swap blocks back and forth for a trickle of rays.
const MOVE: u64 = 4;

pub(super) fn plan(view: &View) -> Vec<Assignment> {
    let mut queues = Queues::new(view);
    let mut camera: Vec<u64> =
        (0..view.splits.len() as u32).map(|s| view.camera.get(&s).copied().unwrap_or(0)).collect();
    let windows = windows(view, &queues, &camera);
    let idle = view.nodes.iter().all(|n| n.free == n.slots);
    let mut out = Vec::new();
    let mut lines: Vec<Option<Line>> = view.nodes.iter().map(|_| None).collect();
    for slot in free_slots(view.nodes).into_iter().rev() {
        let window = &windows[slot as usize];
        let node = &view.nodes[slot as usize];
        let moves = !node.warm.iter().eq(window);
        if window.is_empty() || (moves && node.free < node.slots) {
            // nothing to hold, or the tasks that run still need what it holds
            continue;
        }
        let slots = u64::from(view.nodes[slot as usize].slots.max(1));
        let waiting: u64 = window.iter().map(|&s| queues.rays[s as usize]).sum();
        let to_make: u64 = window.iter().map(|&s| camera[s as usize]).sum();
        let set = Set::Resident(window.clone());
        // few rays: make camera rays first, or wait for those that are on their way
        if waiting > 0 && (waiting >= view.least_rays || (to_make == 0 && idle)) {
            let share = waiting.div_ceil(slots).max(view.least_rays).min(view.task_rays);
            let line = lines[slot as usize].get_or_insert_with(|| queues.line(window));
            let groups = queues.take(line, share, |_, _| ());
            out.push(Assignment { node: slot, set, groups, camera: None });
        } else if to_make > 0 {
            let share = to_make.div_ceil(slots).min(view.task_camera).max(1);
            let mut left = share;
            for &s in window {
                let made = left.min(camera[s as usize]);
                camera[s as usize] -= made;
                left -= made;
            }
            out.push(Assignment { node: slot, set, groups: vec![], camera: Some((share, window.clone())) });
        }
    }
    out
}

/// The window of each node: what it holds, or, if it has nothing to do, what it should hold from now on.
fn windows(view: &View, queues: &Queues, camera: &[u64]) -> Vec<Vec<u32>> {
    let rays: Vec<u64> = queues.rays.iter().zip(camera).map(|(waiting, camera)| waiting + camera).collect();
    let mut before = vec![0u64];
    view.splits.iter().for_each(|s| before.push(before[before.len() - 1] + s.bytes));
    let held = |n: &NodeView| if n.slots == 0 { Vec::new() } else { n.warm.iter().copied().collect() };
    let mut windows: Vec<Vec<u32>> = view.nodes.iter().map(held).collect();
    // by split: nodes that hold it
    let mut claims = vec![0u32; rays.len()];
    windows.iter().flatten().for_each(|&s| claims[s as usize] += 1);
    // by node: what lies on its disk
    let mut disks: Vec<Vec<u32>> = vec![Vec::new(); view.nodes.len()];
    for (s, split) in (0u32..).zip(view.splits) {
        for &n in &split.holders {
            if let Some(disk) = disks.get_mut(n as usize) {
                disk.push(s);
            }
        }
    }
    // splits where rays wait that no node holds, ascending, and those that a node let go of
    let mut open: Vec<u32> =
        (0..rays.len() as u32).filter(|&s| rays[s as usize] > 0 && claims[s as usize] == 0).collect();
    let mut is_near = vec![false; rays.len()];
    for n in 0..view.nodes.len() {
        let node = &view.nodes[n];
        if node.slots == 0 || node.free < node.slots {
            continue;
        }
        disks[n].iter().for_each(|&s| is_near[s as usize] = true);
        // what lies on the node's own disk counts double: reading it moves nothing
        let worth = |s: u32| rays[s as usize] * if is_near[s as usize] { 2 } else { 1 };
        let own: u64 = windows[n].iter().map(|&s| worth(s)).sum();
        // and what it holds that nobody else does
        let alone = windows[n].iter().copied().filter(|&s| claims[s as usize] == 1 && rays[s as usize] > 0);
        let alone: Vec<u32> = alone.collect();
        let more = (!alone.is_empty()).then(|| merged(&open, alone));
        let free = more.as_ref().unwrap_or(&open);
        let best = place::fullest(&before, node.memory.min(view.forest), free, worth);
        let there = best.clone().map_or(0, |b| b.0);
        if let Some((_, range)) = best.filter(|_| there > MOVE * own || (own == 0 && there > 0)) {
            let left = std::mem::replace(&mut windows[n], range.collect());
            left.iter().for_each(|&s| claims[s as usize] -= 1);
            windows[n].iter().for_each(|&s| claims[s as usize] += 1);
            open = merged(&open, left.into_iter().filter(|&s| rays[s as usize] > 0).collect());
            open.retain(|&s| claims[s as usize] == 0);
        }
        disks[n].iter().for_each(|&s| is_near[s as usize] = false);
    }
    windows
}

/// Both, ascending, each number once.
fn merged(a: &[u32], b: Vec<u32>) -> Vec<u32> {
    let mut all = [a, &b].concat();
    // two runs that are in order: it takes linear time
    all.sort();
    all.dedup();
    all
}
