//! The scheduling grid's way: the splits with most rays, one a slot, where they are warm or lie on disk.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use super::{Assignment, Set, Strategy, View, Waiting, free_slots, take};

pub(super) fn plan(view: &View) -> Vec<Assignment> {
    let mut out = Vec::new();
    if !view.reduce.is_empty() {
        reduce(view, &mut out);
        return out;
    }
    let rays: BTreeMap<u32, u64> =
        view.waiting.iter().map(|(&s, g)| (s, g.iter().map(|g| g.rays).sum())).filter(|&(_, n)| n > 0).collect();
    if !rays.is_empty() {
        for (split, node) in choose(view, &rays) {
            let groups = take(&mut largest_first(&view.waiting[&split]).into_iter(), view.task_rays);
            out.push(Assignment { node, set: set(view, split), groups, camera: None });
        }
    } else {
        camera(view, &mut out);
    }
    out
}

/// Camera rays of all start splits, in as many tasks as there are slots: all rays of a round are on their way before
/// the next round reads a split for them.
fn camera(view: &View, out: &mut Vec<Assignment>) {
    let mut left = view.camera.clone();
    let mut nodes = view.nodes.to_vec();
    loop {
        let chosen = choose(&View { nodes: &nodes, ..view.clone() }, &left);
        if chosen.is_empty() {
            return;
        }
        for (split, node) in chosen {
            let rays = left.entry(split).or_default();
            let share = view.task_camera.min(*rays).max(1);
            *rays -= share;
            nodes[node as usize].free -= 1;
            nodes[node as usize].warm.insert(split);
            out.push(Assignment { node, set: set(view, split), groups: vec![], camera: Some((share, vec![split])) });
        }
    }
}

fn set(view: &View, split: u32) -> Set {
    if view.strategy == Strategy::SchedulingGrid { Set::Sharing(split) } else { Set::Resident(vec![split]) }
}

fn largest_first(groups: &[Waiting]) -> Vec<Waiting> {
    let mut groups = groups.to_vec();
    groups.sort_by_key(|g| (Reverse(g.rays), g.id));
    groups
}

/// Splits with their nodes: most rays first, each where it is warm, else where it lies. A split whose nodes are all
/// busy is left for the next round, unless it has at least half of the rays of the fullest one: then any free slot
/// will do, because a slot that waits for it costs more than its bytes.
pub(super) fn choose(view: &View, rays: &BTreeMap<u32, u64>) -> Vec<(u32, u32)> {
    let mut free: Vec<u32> = view.nodes.iter().map(|n| n.free).collect();
    // memory that no warm split takes: a split that finds room there stays warm, and nothing is evicted for it
    let warm_bytes = |n: &super::NodeView| n.warm.iter().map(|&s| view.splits[s as usize].bytes).sum::<u64>();
    let mut room: Vec<u64> = view.nodes.iter().map(|n| n.memory.saturating_sub(warm_bytes(n))).collect();
    let mut splits: Vec<(u32, u64)> = rays.iter().map(|(&s, &r)| (s, r)).filter(|&(_, r)| r > 0).collect();
    splits.sort_by_key(|&(s, r)| (Reverse(r), s));
    let most = splits.first().map_or(0, |s| s.1);
    let mut out = Vec::new();
    let mut later = Vec::new();
    for &(split, rays) in &splits {
        let warm: Vec<u32> = (0..free.len() as u32).filter(|&n| view.nodes[n as usize].warm.contains(&split)).collect();
        let disks: BTreeSet<u32> = view.splits[split as usize].holders.iter().copied().collect();
        let bytes = view.splits[split as usize].bytes;
        let roomy = disks.iter().copied().filter(|&n| room.get(n as usize).is_some_and(|&r| r >= bytes));
        let node = if warm.is_empty() {
            freest(&free, roomy).or_else(|| freest(&free, disks.iter().copied()))
        } else {
            freest(&free, warm.iter().copied())
        };
        match node {
            Some(node) => {
                free[node as usize] -= 1;
                if warm.is_empty() {
                    room[node as usize] = room[node as usize].saturating_sub(bytes);
                }
                out.push((split, node));
            }
            None => later.push((split, rays)),
        }
    }
    for (split, rays) in later {
        if 2 * rays < most && !out.is_empty() {
            break;
        }
        let disks = view.splits[split as usize].holders.iter().copied();
        if let Some(node) = freest(&free, disks).or_else(|| freest(&free, 0..free.len() as u32)) {
            free[node as usize] -= 1;
            out.push((split, node));
        }
    }
    out
}

/// The node with most free slots, the first of equals.
fn freest(free: &[u32], nodes: impl Iterator<Item = u32>) -> Option<u32> {
    nodes.filter(|&n| free.get(n as usize).is_some_and(|&f| f > 0)).max_by_key(|&n| (free[n as usize], Reverse(n)))
}

fn reduce(view: &View, out: &mut Vec<Assignment>) {
    let mut slots = free_slots(view.nodes);
    let total: u64 = view.reduce.iter().map(|g| g.rays).sum();
    let share = total.div_ceil(slots.len() as u64).min(view.task_rays);
    let mut groups = largest_first(&view.reduce).into_iter().peekable();
    while groups.peek().is_some()
        && let Some(node) = slots.pop()
    {
        let groups = take(&mut groups, share);
        out.push(Assignment { node, set: Set::Reduce, groups, camera: None });
    }
}
