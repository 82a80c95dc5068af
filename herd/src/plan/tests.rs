use std::collections::{BTreeMap, BTreeSet};

use proptest::prelude::*;
use rayherd_api::Strategy as Way;

use super::cost::Traffic;
use super::{NodeView, Set, SplitView, View, Waiting, Window, cut, place, plan, rate};

mod twins;

#[derive(Clone, Debug)]
struct Case {
    strategy: Way,
    splits: Vec<SplitView>,
    nodes: Vec<NodeView>,
    waiting: BTreeMap<u32, Vec<Waiting>>,
    reduce: Vec<Waiting>,
    camera: BTreeMap<u32, u64>,
    cut: Vec<Window>,
    traffic: Traffic,
}

impl Case {
    fn view(&self) -> View<'_> {
        View {
            strategy: self.strategy,
            splits: &self.splits,
            nodes: &self.nodes,
            waiting: self.waiting.clone(),
            reduce: self.reduce.clone(),
            camera: self.camera.clone(),
            task_rays: 5000,
            task_camera: 700,
            least_rays: 100,
            replicas: 2,
            forest: u64::MAX,
            cut: &self.cut,
            traffic: self.traffic,
        }
    }
    fn cut(mut self) -> Self {
        self.cut = cut::choose(&self.view());
        self
    }
    fn bytes(&self, set: &[u32]) -> u64 {
        set.iter().map(|&s| self.splits[s as usize].bytes).sum()
    }
}

fn resident(set: &Set) -> Vec<u32> {
    if let Set::Resident(splits) = set { splits.clone() } else { Vec::new() }
}

fn case() -> impl Strategy<Value = Case> {
    let strategy = prop::sample::select(Way::ALL.to_vec());
    let sizes = prop::collection::vec(1u64..100, 1..12);
    (strategy, sizes, 1usize..6, 1u32..4).prop_flat_map(|(strategy, sizes, nodes, replicas)| {
        let n = sizes.len() as u32;
        let largest = sizes.iter().copied().max().unwrap_or(1);
        let holders = place::holders(&sizes, nodes as u32, replicas);
        let splits: Vec<SplitView> =
            sizes.iter().zip(holders).map(|(&bytes, holders)| SplitView { bytes, holders }).collect();
        let node = (0u32..4, 0u32..4, largest..900, prop::collection::btree_set(0..n, 0..4))
            .prop_map(|(slots, busy, memory, warm)| NodeView { slots, free: slots.saturating_sub(busy), memory, warm });
        let group = (0..n, 1u64..3000);
        (
            prop::collection::vec(node, nodes),
            prop::collection::vec(group, 0..30),
            prop::collection::vec(1u64..3000, 0..4),
            prop::collection::btree_map(0..n, 1u64..9000, 0..4),
            proptest::bool::ANY,
        )
            .prop_map(move |(nodes, groups, reduce, camera, moving)| {
                let mut waiting: BTreeMap<u32, Vec<Waiting>> = BTreeMap::new();
                for (id, (split, rays)) in groups.into_iter().enumerate() {
                    waiting.entry(split).or_default().push(Waiting { id, rays });
                }
                let reduce = if strategy == Way::SchedulingGrid { reduce } else { vec![] };
                let reduce = reduce.into_iter().enumerate().map(|(i, rays)| Waiting { id: 1000 + i, rays }).collect();
                let sizes = splits.clone();
                // what is warm fits
                let nodes = nodes
                    .into_iter()
                    .map(|mut n| {
                        while n.warm.iter().map(|&s| sizes[s as usize].bytes).sum::<u64>() > n.memory {
                            n.warm.pop_last();
                        }
                        n
                    })
                    .collect();
                let (cut, traffic) = (Vec::new(), Traffic::default());
                let case = Case { strategy, splits: splits.clone(), nodes, waiting, reduce, camera, cut, traffic };
                if moving { case } else { case.cut() }
            })
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]

    #[test]
    fn plans_keep_their_promises(case in case()) {
        let view = case.view();
        let out = plan(&view);
        let mut used = vec![0; case.nodes.len()];
        let mut groups = BTreeSet::new();
        for a in &out {
            used[a.node as usize] += 1;
            for g in &a.groups {
                prop_assert!(groups.insert(*g), "group {} dealt twice", g);
            }
            prop_assert!(!a.groups.is_empty() || a.camera.is_some());
            let by_id = |id: usize| case.waiting.iter().find(|(_, q)| q.iter().any(|g| g.id == id)).map(|(s, _)| *s);
            match &a.set {
                Set::Resident(set) => {
                    prop_assert!(case.bytes(set) <= case.nodes[a.node as usize].memory);
                    prop_assert!(a.groups.iter().all(|&g| set.contains(&by_id(g).unwrap())));
                    if let Some((_, from)) = &a.camera {
                        prop_assert!(from.iter().all(|s| set.contains(s)));
                    }
                }
                Set::Sharing(split) => prop_assert!(a.groups.iter().all(|&g| by_id(g) == Some(*split))),
                Set::Reduce => prop_assert!(a.groups.iter().all(|&g| g >= 1000)),
                Set::Any => {}
            }
        }
        for (n, node) in case.nodes.iter().enumerate() {
            prop_assert!(used[n] <= node.free, "node {} has {} free slots, got {} tasks", n, node.free, used[n]);
        }
        // what the tasks of a node of auto hold together fits, and what runs keeps what it has
        if case.strategy == Way::Auto {
            for (n, node) in (0u32..).zip(&case.nodes) {
                let sets: BTreeSet<u32> = out.iter().filter(|a| a.node == n).flat_map(|a| resident(&a.set)).collect();
                let together: BTreeSet<u32> = sets.union(&node.warm).copied().collect();
                let needed = if node.free < node.slots && !sets.is_empty() { together } else { sets };
                let needed: Vec<u32> = needed.into_iter().collect();
                prop_assert!(case.bytes(&needed) <= node.memory, "node {} is to hold {:?}", n, needed);
            }
        }
        // nothing starves: with all slots free and something to do there is a task
        let mut idle = case.clone();
        idle.nodes.iter_mut().for_each(|n| n.free = n.slots);
        let work = !case.waiting.is_empty() || !case.reduce.is_empty() || !case.camera.is_empty();
        if idle.nodes.iter().any(|n| n.slots > 0) && work {
            prop_assert!(!plan(&idle.view()).is_empty());
        }
        prop_assert_eq!(plan(&view), out, "a plan is a function of its view");
    }

    #[test]
    fn copies_lie_on_distinct_nodes_in_connected_pieces(sizes in prop::collection::vec(1u64..100, 1..50), nodes in 1u32..9, replicas in 1u32..4) {
        let holders = place::holders(&sizes, nodes, replicas);
        for h in &holders {
            let distinct: BTreeSet<&u32> = h.iter().collect();
            prop_assert_eq!((h.len(), distinct.len()), (replicas.min(nodes) as usize, replicas.min(nodes) as usize));
        }
        for n in 0..nodes {
            let on: Vec<bool> = holders.iter().map(|h| h.contains(&n)).collect();
            let starts = (0..on.len()).filter(|&i| on[i] && !on[(i + on.len() - 1) % on.len()]).count();
            prop_assert!(starts <= 1, "node {} holds {} pieces of the ring", n, starts);
        }
    }
}

/// Nodes that hold nothing yet, of a scene whose splits are all of a size.
fn fresh(splits: u32, bytes: u64, slots: &[u32], memory: u64) -> Case {
    let holders = place::holders(&vec![bytes; splits as usize], slots.len() as u32, 2);
    let node = |&slots: &u32| NodeView { slots, free: slots, memory, warm: BTreeSet::new() };
    Case {
        strategy: Way::Auto,
        splits: holders.into_iter().map(|holders| SplitView { bytes, holders }).collect(),
        nodes: slots.iter().map(node).collect(),
        waiting: BTreeMap::new(),
        reduce: vec![],
        camera: BTreeMap::new(),
        cut: vec![],
        traffic: Traffic::default(),
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    #[test]
    fn a_cut_covers_the_scene_and_fits(mut case in case()) {
        case.nodes.iter_mut().for_each(|n| n.warm.clear());
        let cut = cut::choose(&case.view());
        prop_assert!(cut.iter().all(|w| !w.is_empty()));
        if !cut.is_empty() {
            let splits: BTreeSet<u32> = cut.iter().flatten().copied().collect();
            prop_assert!(splits.into_iter().eq(0..case.splits.len() as u32));
            prop_assert!(cut.iter().all(|w| w.is_sorted_by(|a, b| a < b)));
        }
        let mut rooms: Vec<u64> = case.nodes.iter().filter(|n| n.slots > 0).map(|n| n.memory).collect();
        rooms.sort_unstable();
        for window in &cut {
            let room = rooms.iter().position(|&r| r >= case.bytes(window));
            prop_assert!(room.is_some(), "no node is left for {:?}", window);
            rooms.remove(room.unwrap());
        }
        let kept = Case { cut: cut.clone(), ..case.clone() };
        prop_assert_eq!(cut::choose(&kept.view()), cut, "the cheapest cut is kept");
    }
}

#[test]
fn a_small_scene_with_many_rays_is_replicated_and_no_ray_waits() {
    let mut case = fresh(3, 1000, &[2, 2], 5000);
    case.camera = BTreeMap::from([(1, 100_000)]);
    let case = case.cut();
    assert_eq!(case.cut.as_slice(), [vec![0, 1, 2]]);
    let mut view = case.view();
    view.task_camera = 1 << 30;
    let out = plan(&view);
    assert_eq!(out.iter().map(|a| a.node).collect::<Vec<_>>(), [0, 1, 0, 1]);
    assert!(out.iter().all(|a| a.set == Set::Resident(vec![0, 1, 2]) && a.camera.as_ref().unwrap().1.is_empty()));
    assert_eq!(out[0].camera.as_ref().unwrap().0, 12_500);
}

#[test]
fn few_rays_load_no_copy() {
    let mut case = fresh(8, 1_000_000, &[1; 4], u64::MAX);
    case.camera = BTreeMap::from([(0, 1000)]);
    let case = case.cut();
    assert!(case.cut.len() > 1, "{:?}", case.cut);
    let out = plan(&case.view());
    assert_eq!(out.len(), 1, "{out:?}");
    // a node that has a copy on its disk, of the part where the camera rays start
    assert!(case.splits[0].holders.contains(&out[0].node) && resident(&out[0].set).contains(&0));
}

#[test]
fn a_window_in_a_quarter_of_the_scene_is_no_larger_and_lies_where_the_copies_are() {
    let mut case = fresh(32, 10_000_000, &[2, 2, 2, 2, 4, 4, 4, 4], 80_000_000);
    case.camera = (0..32).map(|s| (s, 10_000)).collect();
    let case = case.cut();
    assert!((4..=8).contains(&case.cut.len()) && case.cut.iter().all(|w| w.len() <= 8), "{:?}", case.cut);
    let out = plan(&case.view());
    assert!(out.iter().map(|a| a.node).collect::<BTreeSet<_>>().len() >= 7, "{out:?}");
    for a in out {
        let set = resident(&a.set);
        assert!(
            set.iter().all(|&s| case.splits[s as usize].holders.contains(&a.node)),
            "node {} loads {set:?}",
            a.node
        );
    }
}

/// What a simulated run did.
#[derive(Debug)]
struct Simulated {
    /// Bytes loaded / bytes of the scene.
    passes: f64,
    /// Part of the bytes loaded that came from other nodes.
    remote: f64,
    /// Nodes that worked.
    worked: usize,
}

/// Runs a job of so many camera rays to its end without tracing: each ray leads to half another one, and one in four of
/// all leaves its window.
fn simulated(strategy: Way, memory: u64, camera: u64) -> Simulated {
    let mut case = Case { strategy, ..fresh(32, 16_000_000, &[2, 2, 2, 2, 4, 4, 4, 4], memory) };
    // a third of the splits is in view
    case.camera = (0..11).map(|s| (s, camera / 11)).collect();
    let mut case = if strategy == Way::Auto { case.cut() } else { case };
    let (mut loaded, mut far, mut worked, mut next) = (0, 0, BTreeSet::new(), 0);
    for _ in 0..100_000 {
        let mut view = case.view();
        (view.task_rays, view.task_camera, view.least_rays) = (200_000, 200_000, 4000);
        let out = plan(&view);
        if out.is_empty() {
            assert!(case.camera.is_empty() && case.waiting.is_empty(), "something waits and nothing is planned");
            let all = case.bytes(&(0..32).collect::<Vec<_>>()) as f64;
            return Simulated { passes: loaded as f64 / all, remote: far as f64 / loaded as f64, worked: worked.len() };
        }
        for a in out {
            worked.insert(a.node);
            let set: BTreeSet<u32> = resident(&a.set).into_iter().collect();
            let cold: Vec<u32> = set.difference(&case.nodes[a.node as usize].warm).copied().collect();
            loaded += case.bytes(&cold);
            let elsewhere = cold.iter().filter(|&&s| !case.splits[s as usize].holders.contains(&a.node));
            far += case.bytes(&elsewhere.copied().collect::<Vec<_>>());
            let both: Vec<u32> = set.union(&case.nodes[a.node as usize].warm).copied().collect();
            let moving = strategy == Way::Auto && case.cut.is_empty();
            let beside = !moving && case.bytes(&both) <= memory;
            case.nodes[a.node as usize].warm = if beside { both.into_iter().collect() } else { set.clone() };
            let mut rays = 0;
            for queue in case.waiting.values_mut() {
                queue.retain(|g| {
                    !a.groups.contains(&g.id) || {
                        rays += g.rays;
                        false
                    }
                });
            }
            if let Some((mut left, from)) = a.camera {
                let from: Vec<u32> = if from.is_empty() { set.iter().copied().collect() } else { from };
                for s in from {
                    let made = case.camera.get(&s).map_or(0, |&c| c.min(left));
                    case.camera.entry(s).and_modify(|c| *c -= made);
                    (left, rays) = (left - made, rays + made);
                }
                case.camera.retain(|_, c| *c > 0);
            }
            case.waiting.retain(|_, q| !q.is_empty());
            let leaves = if set.len() == 32 { 0 } else { rays / 4 };
            let others: Vec<u32> = (0..32).filter(|s| !set.contains(s)).collect();
            for (i, to) in others.iter().enumerate().skip(next % 4).step_by(4) {
                let rays = leaves * 4 / others.len() as u64 + u64::from(i == 0);
                if rays > 0 && leaves > 0 {
                    case.waiting.entry(*to).or_default().push(Waiting { id: next * 100 + i, rays });
                }
            }
            next += 1;
        }
    }
    panic!("it does not end");
}

#[test]
fn passes_grow_slower_than_the_root_of_the_samples() {
    for memory in [128_000_000, u64::MAX] {
        let made = [1_000_000, 4_000_000, 16_000_000, 64_000_000].map(|n| simulated(Way::Auto, memory, n));
        assert!(made[0].passes <= 1.6 && made[1].passes <= 2.0, "{made:?}");
        // from one window to the next, and at last to the whole scene on each node
        let slower = |(one, root): (&Simulated, f64)| one.passes < root * made[0].passes;
        assert!(made.iter().skip(1).zip([2.0, 4.0, 8.0]).all(slower), "{made:?}");
        assert_eq!(made[3].worked, 8, "with much to do everyone works: {made:?}");
        // few rays are no reason to load what lies elsewhere
        assert!(made[0].remote <= 0.125 && made[1].remote <= 0.125, "{made:?}");
    }
    // memory for half the scene: windows move
    assert!(simulated(Way::Auto, 32_000_000, 1_000_000).passes > 1.0);
}

#[test]
fn the_grid_stays_where_the_copies_are() {
    for camera in [1_000_000, 4_000_000, 16_000_000] {
        let made = simulated(Way::SchedulingGridOverlapReduced, 64_000_000, camera);
        assert!(made.remote <= 0.1, "{camera}: {made:?}");
    }
}

#[test]
fn traffic_starts_with_what_is_assumed_and_follows_what_is_counted() {
    let mut traffic = Traffic::default();
    assert_eq!((traffic.rays_per_camera(), traffic.bytes_per_hop(), traffic.hops_per_ray(1.0)), (2.0, 20.0, 0.0));
    assert!((traffic.hops_per_ray(8.0) - 1.0 / 3.0).abs() < 1e-12);
    traffic.add(1_000_000, 5_000_000, 8.0, 1_000_000, 15_000_000);
    assert!((4.9..5.0).contains(&traffic.rays_per_camera()));
    assert!((15.0..15.1).contains(&traffic.bytes_per_hop()));
    assert!((0.19..0.21).contains(&traffic.hops_per_ray(8.0)) && traffic.hops_per_ray(27.0) > 0.38);
}

#[test]
fn windows_that_cannot_cover_move_to_the_rays() {
    let mut case = fresh(4, 10, &[1], 20);
    case.nodes[0].warm = BTreeSet::from([0, 1]);
    case.waiting = BTreeMap::from([(3, vec![Waiting { id: 0, rays: 500 }]), (0, vec![Waiting { id: 1, rays: 200 }])]);
    assert!(cut::choose(&case.view()).is_empty());
    assert_eq!(plan(&case.view())[0].set, Set::Resident(vec![0, 1]));
    case.waiting.remove(&0);
    let out = plan(&case.view());
    assert!(matches!(&out[0].set, Set::Resident(s) if s.contains(&3)));
}

#[test]
fn rates_turn_seconds_into_rays() {
    let mut rate = rate::Rate::UNKNOWN;
    for _ in 0..100 {
        rate.add(2.0, 1_000_000, 100_000);
        rate.add(1.0, 500_000, 0);
    }
    assert!((450_000..550_000).contains(&rate.rays(1.0)), "{}", rate.rays(1.0));
    assert!((450_000..550_000).contains(&rate.camera(10.0)), "{}", rate.camera(10.0));
    assert_eq!(rate::Rate::UNKNOWN.rays(0.0), 1);
}
