//! The scheduling grid's way: the splits with most rays, one a slot, where they are warm or lie on disk.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use super::cost::{RAY, REMOTE};
use super::{Assignment, Set, Strategy, View, Waiting, free_slots, take};

pub(super) fn plan(view: &View) -> Vec<Assignment> {
    let mut out = Vec::new();
    if !view.reduce.is_empty() {
        reduce(view, &mut out);
        return out;
    }
    let idle = view.nodes.iter().all(|n| n.free == n.slots);
    let rays: BTreeMap<u32, u64> =
        view.waiting.iter().map(|(&s, g)| (s, g.iter().map(|g| g.rays).sum())).filter(|&(_, n)| n > 0).collect();
    if !rays.is_empty() {
        for (split, node) in choose(view, &rays, idle) {
            let groups = take(&mut largest_first(&view.waiting[&split]).into_iter(), view.task_rays);
            out.push(Assignment { node, set: set(view, split), groups, camera: None });
        }
    } else {
        camera(view, idle, &mut out);
    }
    out
}

/// Camera rays of all start splits, in as many tasks as there are slots: all rays of a round are on their way before
/// the next round reads a split for them.
fn camera(view: &View, idle: bool, out: &mut Vec<Assignment>) {
    let mut left = view.camera.clone();
    let mut nodes = view.nodes.to_vec();
    loop {
        let chosen = choose(&View { nodes: &nodes, ..view.clone() }, &left, idle && out.is_empty());
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

/// Splits with their nodes: most rays first, each where it is warm, else where it lies. Of the splits whose nodes these are, as many
/// of those with most rays get a slot as can at once: one that came first makes way when another of its own nodes will do.
///
/// A split whose nodes are all busy is left for the next round, unless it has at least half of the rays of the fullest one and is
/// worth it: a slot that stands idle for its rays costs more than reading it from another node. With `any`, something is
/// chosen whatever it costs.
pub(super) fn choose(view: &View, rays: &BTreeMap<u32, u64>, any: bool) -> Vec<(u32, u32)> {
    let mut splits: Vec<(u32, u64)> = rays.iter().map(|(&s, &r)| (s, r)).filter(|&(_, r)| r > 0).collect();
    splits.sort_by_key(|&(s, r)| (Reverse(r), s));
    let most = splits.first().map_or(0, |s| s.1);
    let mut seats = Seats::new(view);
    let mut later = Vec::new();
    for &(split, rays) in &splits {
        let mut tried = BTreeSet::new();
        if !seats.seat(split, &mut tried) {
            // from where nobody could be moved, nobody ever will be: all their own nodes are among these
            tried.into_iter().for_each(|n| seats.stuck[n as usize] = true);
            later.push((split, rays));
        }
    }
    for (split, rays) in later {
        if seats.left == 0 || (2 * rays < most && !(any && seats.taken.is_empty())) {
            break;
        }
        let disks = seats.live_holders(split);
        let bytes = view.splits[split as usize].bytes;
        let worth = rays.min(view.task_rays).saturating_mul(RAY) >= bytes.saturating_mul(REMOTE);
        let anywhere = worth || disks.is_empty() || (any && seats.taken.is_empty());
        let near = freest(&seats.free, disks.into_iter());
        let node = near.or_else(|| freest(&seats.free, 0..seats.free.len() as u32).filter(|_| anywhere));
        if let Some(node) = node {
            seats.take(split, node);
        }
    }
    seats.taken.into_values().collect()
}

/// Slots that are free, and who gets them.
struct Seats<'v, 'a> {
    view: &'v View<'a>,
    free: Vec<u32>,
    /// Memory that no warm split takes: a split that finds room there stays warm, and nothing is evicted for it.
    room: Vec<i128>,
    /// All free slots.
    left: u64,
    /// By split: live nodes where it is warm.
    warm: Vec<Vec<u32>>,
    /// Split and node, in the order in which they were taken.
    taken: BTreeMap<u64, (u32, u32)>,
    /// By node: what of those has its slots, by place in that order.
    on: Vec<Vec<(u64, u32)>>,
    /// By node: whether nobody there can ever be moved.
    stuck: Vec<bool>,
}

impl<'v, 'a> Seats<'v, 'a> {
    fn new(view: &'v View<'a>) -> Self {
        let bytes = |s: &u32| i128::from(view.splits[*s as usize].bytes);
        let room = |n: &super::NodeView| i128::from(n.memory) - n.warm.iter().map(bytes).sum::<i128>();
        let mut warm = vec![Vec::new(); view.splits.len()];
        for (n, node) in (0u32..).zip(view.nodes).filter(|(_, node)| node.slots > 0) {
            node.warm.iter().for_each(|&s| warm[s as usize].push(n));
        }
        Seats {
            view,
            free: view.nodes.iter().map(|n| n.free).collect(),
            room: view.nodes.iter().map(room).collect(),
            left: view.nodes.iter().map(|n| u64::from(n.free)).sum(),
            warm,
            taken: BTreeMap::new(),
            on: vec![Vec::new(); view.nodes.len()],
            stuck: vec![false; view.nodes.len()],
        }
    }

    fn live_holders(&self, split: u32) -> Vec<u32> {
        let holders = self.view.splits[split as usize].holders.iter().copied();
        let live = |&n: &u32| self.view.nodes.get(n as usize).is_some_and(|n| n.slots > 0);
        holders.filter(live).collect::<BTreeSet<u32>>().into_iter().collect()
    }

    /// The nodes where a split belongs, and whether it is warm there.
    fn own(&self, split: u32) -> (Vec<u32>, bool) {
        let warm = &self.warm[split as usize];
        if warm.is_empty() { (self.live_holders(split), false) } else { (warm.clone(), true) }
    }

    fn take(&mut self, split: u32, node: u32) {
        self.free[node as usize] -= 1;
        self.left -= 1;
        if !self.view.nodes[node as usize].warm.contains(&split) {
            self.room[node as usize] -= i128::from(self.view.splits[split as usize].bytes);
        }
        let place = self.taken.last_key_value().map_or(0, |(last, _)| last + 1);
        self.taken.insert(place, (split, node));
        self.on[node as usize].push((place, split));
    }

    /// Gives back the slot that was taken at this place in the order.
    fn leave(&mut self, place: u64) {
        let Some((split, node)) = self.taken.remove(&place) else { return };
        self.on[node as usize].retain(|&(other, _)| other != place);
        self.free[node as usize] += 1;
        self.left += 1;
        if !self.view.nodes[node as usize].warm.contains(&split) {
            self.room[node as usize] += i128::from(self.view.splits[split as usize].bytes);
        }
    }

    /// Gives a split a slot of one of its own nodes, if need be by moving others to other nodes of theirs (an augmenting path). `tried`
    /// are nodes from which nobody can be moved. Whoever has a slot keeps one.
    fn seat(&mut self, split: u32, tried: &mut BTreeSet<u32>) -> bool {
        let (own, warm) = self.own(split);
        let bytes = i128::from(self.view.splits[split as usize].bytes);
        let roomy = own.iter().copied().filter(|&n| !warm && self.room[n as usize] >= bytes);
        if let Some(node) = freest(&self.free, roomy).or_else(|| freest(&self.free, own.iter().copied())) {
            self.take(split, node);
            return true;
        }
        for node in own {
            if self.stuck[node as usize] || !tried.insert(node) {
                continue;
            }
            // those with fewest rays came last, and move first
            for (place, other) in self.on[node as usize].clone().into_iter().rev() {
                if self.seat(other, tried) {
                    // it has two slots now: the old one is free
                    self.leave(place);
                    self.take(split, node);
                    return true;
                }
            }
        }
        false
    }
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
