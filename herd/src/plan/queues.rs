//! Groups that wait, by split: tasks take the largest of some splits.

use std::cmp::Reverse;

use super::{View, Waiting};

/// What waits for each split.
pub(super) struct Queues {
    groups: Vec<Vec<Waiting>>,
    /// By split and group: whether a task has it.
    taken: Vec<Vec<bool>>,
    /// By split: rays of the groups that no task has.
    pub rays: Vec<u64>,
}

/// Groups of some splits in the order in which tasks take them, the first at the end, by split and place in its queue. Those that were taken by way
/// of another line are passed over.
pub(super) struct Line(Vec<(u32, usize)>);

impl Queues {
    pub fn new(view: &View) -> Queues {
        let of = |s: u32| view.waiting.get(&s).cloned().unwrap_or_default();
        let groups: Vec<Vec<Waiting>> = (0..view.splits.len() as u32).map(of).collect();
        Queues {
            taken: groups.iter().map(|g| vec![false; g.len()]).collect(),
            rays: groups.iter().map(|g| g.iter().map(|g| g.rays).sum()).collect(),
            groups,
        }
    }

    /// The groups that wait for these splits, the largest first.
    pub fn line(&self, splits: &[u32]) -> Line {
        let of = |&s: &u32| (0..self.groups[s as usize].len()).map(move |at| (s, at));
        let mut line: Vec<(u32, usize)> = splits.iter().flat_map(of).collect();
        line.sort_by_key(|&(s, at)| {
            let group = self.groups[s as usize][at];
            (group.rays, Reverse(group.id))
        });
        Line(line)
    }

    /// Takes groups until there are `rays` of them, at least one; `took` is told of each its split and rays.
    pub fn take(&mut self, line: &mut Line, rays: u64, mut took: impl FnMut(u32, u64)) -> Vec<usize> {
        let (mut out, mut sum) = (Vec::new(), 0);
        while sum < rays.max(1)
            && let Some((split, at)) = line.0.pop()
        {
            let taken = &mut self.taken[split as usize][at];
            if std::mem::replace(taken, true) {
                continue;
            }
            let group = self.groups[split as usize][at];
            self.rays[split as usize] -= group.rays;
            sum += group.rays;
            took(split, group.rays);
            out.push(group.id);
        }
        out
    }
}
