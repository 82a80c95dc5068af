use std::collections::{BTreeMap, BTreeSet};

use proptest::prelude::*;
use rayherd_api::Strategy as Way;

use super::{NodeView, Set, SplitView, View, Waiting, grid, place, plan, rate};

#[derive(Clone, Debug)]
struct Case {
    strategy: Way,
    splits: Vec<SplitView>,
    nodes: Vec<NodeView>,
    waiting: BTreeMap<u32, Vec<Waiting>>,
    reduce: Vec<Waiting>,
    camera: BTreeMap<u32, u64>,
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
        }
    }
    fn bytes(&self, set: &[u32]) -> u64 {
        set.iter().map(|&s| self.splits[s as usize].bytes).sum()
    }
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
        )
            .prop_map(move |(nodes, groups, reduce, camera)| {
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
                Case { strategy, splits: splits.clone(), nodes, waiting, reduce, camera }
            })
    })
}

/// The splits that a round of the scheduling grid takes, by repeated search: the plain twin of [`grid::choose`].
fn naive_choose(view: &View, rays: &BTreeMap<u32, u64>) -> Vec<(u32, u32)> {
    let mut left = rays.clone();
    let mut out: Vec<(u32, u32)> = Vec::new();
    let most = rays.values().copied().max().unwrap_or(0);
    let free =
        |out: &[(u32, u32)], n: u32| view.nodes[n as usize].free - out.iter().filter(|a| a.1 == n).count() as u32;
    let size = |s: u32| view.splits[s as usize].bytes;
    let room = |out: &[(u32, u32)], n: u32| {
        let node = &view.nodes[n as usize];
        let loads = out.iter().filter(|a| a.1 == n && !node.warm.contains(&a.0)).map(|a| size(a.0)).sum::<u64>();
        let warm = node.warm.iter().map(|&s| size(s)).sum::<u64>();
        node.memory.saturating_sub(warm + loads)
    };
    for pass in 0..2 {
        let mut seen = BTreeSet::new();
        while let Some((&split, &r)) =
            left.iter().filter(|(s, _)| !seen.contains(*s)).max_by_key(|(s, r)| (**r, std::cmp::Reverse(**s)))
        {
            seen.insert(split);
            if pass == 1 && 2 * r < most && !out.is_empty() {
                break;
            }
            let score = |n: u32| {
                let f = free(&out, n);
                let warm = view.nodes[n as usize].warm.contains(&split);
                let anywhere_warm = view.nodes.iter().any(|v| v.warm.contains(&split));
                let disk = view.splits[split as usize].holders.contains(&n);
                let rank = if pass == 1 {
                    1 + u32::from(disk)
                } else if anywhere_warm {
                    u32::from(warm)
                } else if disk {
                    1 + u32::from(room(&out, n) >= size(split))
                } else {
                    0
                };
                (rank, f, std::cmp::Reverse(n))
            };
            let nodes = (0..view.nodes.len() as u32).filter(|&n| free(&out, n) > 0 && score(n).0 > 0);
            if let Some(node) = nodes.max_by_key(|&n| score(n)) {
                out.push((split, node));
                left.remove(&split);
            }
        }
    }
    out
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
        // two different resident sets never meet on a node of auto
        if case.strategy == Way::Auto {
            let sets: BTreeSet<(u32, &Vec<u32>)> =
                out.iter().filter_map(|a| if let Set::Resident(s) = &a.set { Some((a.node, s)) } else { None }).collect();
            let nodes: BTreeSet<u32> = sets.iter().map(|s| s.0).collect();
            prop_assert_eq!(sets.len(), nodes.len());
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
    fn the_grid_chooses_as_its_plain_twin_does(case in case()) {
        let view = case.view();
        let rays: BTreeMap<u32, u64> =
            case.waiting.iter().map(|(&s, g)| (s, g.iter().map(|g| g.rays).sum())).collect();
        prop_assert_eq!(grid::choose(&view, &rays), naive_choose(&view, &rays));
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

#[test]
fn a_scene_that_fits_is_replicated_and_no_ray_waits() {
    let case = Case {
        strategy: Way::Auto,
        splits: vec![SplitView { bytes: 10, holders: vec![0] }; 3],
        nodes: vec![NodeView { slots: 2, free: 2, memory: 30, warm: BTreeSet::new() }; 2],
        waiting: BTreeMap::new(),
        reduce: vec![],
        camera: BTreeMap::from([(1, 1000)]),
    };
    let out = plan(&case.view());
    assert_eq!(out.iter().map(|a| a.node).collect::<Vec<_>>(), [0, 1, 0, 1]);
    assert!(out.iter().all(|a| a.set == Set::Resident(vec![0, 1, 2]) && a.camera == Some((125, vec![]))));
}

#[test]
fn windows_of_a_quarter_on_eight_nodes_cover_the_scene_twice_and_lie_where_the_copies_are() {
    let sizes = [10; 32];
    let windows = place::windows(&sizes, &[80; 8]);
    assert!(place::covers(32, &windows));
    assert!(windows.iter().all(|w| w.len() == 8));
    let holders = place::holders(&sizes, 8, 2);
    let local = windows.iter().enumerate().flat_map(|(n, w)| w.iter().map(move |&s| (n, s)));
    assert!(local.clone().all(|(n, s)| holders[s as usize].contains(&(n as u32))));
}

#[test]
fn windows_that_cannot_cover_move_to_the_rays() {
    let mut case = Case {
        strategy: Way::Auto,
        splits: vec![SplitView { bytes: 10, holders: vec![0] }; 4],
        nodes: vec![NodeView { slots: 1, free: 1, memory: 20, warm: BTreeSet::from([0, 1]) }],
        waiting: BTreeMap::from([(3, vec![Waiting { id: 0, rays: 500 }]), (0, vec![Waiting { id: 1, rays: 200 }])]),
        reduce: vec![],
        camera: BTreeMap::new(),
    };
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
