//! What the planner sees, and what is remembered of its plan.

use std::collections::{BTreeMap, BTreeSet};

use super::{Driver, Executor, FilmSum};
use crate::job::NodeSpec;
use crate::ledger::{Destination, GroupRef};
use crate::plan::{self, Assignment, NodeView, SplitView, View, Waiting};
use crate::resident::FOREST_BYTES;

impl<F: FilmSum> Driver<'_, '_, F> {
    /// What to start now, with the keys of the groups that each takes.
    pub(super) fn plan(&mut self, executor: &dyn Executor) -> Vec<(Assignment, Vec<String>)> {
        if (0..self.free.len() as u32).all(|n| !executor.is_up(n)) {
            return Vec::new();
        }
        let settings = self.shared.settings;
        let holders = executor.holders();
        // on machines of their own nodes' memories cannot be looked into
        let elsewhere = holders.is_some();
        let holders = holders.unwrap_or_else(|| self.shared.nodes.holders());
        let split =
            |&s: &u32| SplitView { bytes: self.shared.scene.split_bytes(s), holders: holders[s as usize].clone() };
        let splits: Vec<SplitView> = self.order.iter().map(split).collect();
        let groups: Vec<&GroupRef> = self.ledger.waiting().collect();
        let mut waiting: BTreeMap<u32, Vec<Waiting>> = BTreeMap::new();
        let mut reduce = Vec::new();
        for (id, group) in groups.iter().enumerate() {
            let entry = Waiting { id, rays: u64::from(group.rays) };
            match group.to {
                Destination::Split(s) => waiting.entry(self.rank[s as usize]).or_default().push(entry),
                Destination::Reduce(_) => reduce.push(entry),
            }
        }
        // the nodes as they are for a new cut: what they hold was for the old one
        let bare: Vec<NodeView>;
        let mut view = View {
            strategy: settings.strategy,
            splits: &splits,
            nodes: &self.nodes_as_seen(executor, elsewhere),
            waiting,
            reduce,
            camera: self.cameras.rays(),
            task_rays: self.rate.rays(settings.task_seconds),
            task_camera: self.rate.camera(settings.task_seconds),
            least_rays: u64::from(settings.batch),
            replicas: settings.replicas,
            forest: FOREST_BYTES.saturating_sub(self.shared.scene.top_bytes()),
            cut: self.cut.as_deref().unwrap_or_default(),
            traffic: self.traffic,
        };
        // a new cut is worth a thought when nothing is under way that was made for the old one
        let mut cut = None;
        if settings.strategy == plan::Strategy::Auto
            && (self.cut.is_none() || (self.live.is_empty() && groups.is_empty()))
        {
            cut = Some(plan::cut::choose(&view)).filter(|c| Some(c) != self.cut.as_ref());
        }
        if let Some(cut) = &cut {
            bare = view.nodes.iter().map(|n| NodeView { warm: BTreeSet::new(), ..n.clone() }).collect();
            (view.cut, view.nodes) = (cut, &bare);
        }
        let with_keys = |a: Assignment| {
            let keys = a.groups.iter().map(|&g| groups[g].key.clone()).collect();
            (a, keys)
        };
        let plan = plan::plan(&view).into_iter().map(with_keys).collect();
        if let Some(cut) = cut {
            self.parts = plan::cut::parts(splits.iter().map(|s| s.bytes), &cut);
            self.windows.iter_mut().for_each(BTreeSet::clear);
            self.cut = Some(cut);
        }
        plan
    }

    /// The nodes as the planner sees them.
    fn nodes_as_seen(&self, executor: &dyn Executor, elsewhere: bool) -> Vec<NodeView> {
        let settings = self.shared.settings;
        let node = |(n, spec): (usize, &NodeSpec)| {
            let memory = self.shared.nodes.memory(n as u32);
            let warm = if settings.strategy == plan::Strategy::Auto {
                self.windows[n].clone()
            } else if elsewhere {
                self.recent[n].iter().copied().collect()
            } else {
                memory.warm().into_iter().map(|s| self.rank[s as usize]).collect()
            };
            let up = |slots| if executor.is_up(n as u32) { slots } else { 0 };
            NodeView { slots: up(spec.slots), free: up(self.free[n]), memory: self.capacity(n as u32), warm }
        };
        settings.nodes.iter().enumerate().map(node).collect()
    }

    /// Remembers that a node was given splits: the oldest go when its memory does not hold all, as they do there.
    pub(super) fn remember(&mut self, node: u32, ranks: &[u32]) {
        let (scene, order, capacity) = (self.shared.scene, &self.order, self.capacity(node));
        let held = &mut self.recent[node as usize];
        held.retain(|r| !ranks.contains(r));
        held.extend(ranks);
        let bytes = |r: &u32| scene.split_bytes(order[*r as usize]);
        let mut sum: u64 = held.iter().map(bytes).sum();
        while sum > capacity && held.len() > ranks.len() {
            sum -= bytes(&held.remove(0));
        }
    }

    /// What a node may hold of the scene, bytes.
    pub(super) fn capacity(&self, node: u32) -> u64 {
        self.shared.nodes.memory(node).capacity().min(self.memory)
    }

    /// Nodes have too little memory for what they were given: the scene is cut anew for what they may hold now.
    pub(super) fn take_less(&mut self, executor: &dyn Executor) {
        self.memory = executor.memory().unwrap_or(u64::MAX);
        (0..self.free.len() as u32).for_each(|n| self.forget(n));
        self.cut = None;
    }

    /// A node has lost what it held.
    pub(super) fn forget(&mut self, node: u32) {
        self.windows[node as usize].clear();
        self.recent[node as usize].clear();
    }

    /// Remembers the window that a node of `auto` is to hold: beside what it holds if there is room, else instead of it.
    pub(super) fn hold(&mut self, node: u32, ranks: &[u32]) {
        let (scene, capacity) = (self.shared.scene, self.capacity(node));
        let held = &mut self.windows[node as usize];
        let both: BTreeSet<u32> = held.iter().chain(ranks).copied().collect();
        let bytes: u64 = both.iter().map(|&r| scene.split_bytes(self.order[r as usize])).sum();
        // windows that overlap would be in memory twice
        let there = ranks.iter().filter(|r| held.contains(r)).count();
        let beside =
            (there == 0 || there == ranks.len()) && bytes <= capacity && !self.cut.as_ref().is_none_or(Vec::is_empty);
        *held = if beside { both } else { ranks.iter().copied().collect() };
    }
}
