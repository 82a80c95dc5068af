//! A light tree: which of many local sources, by what may arrive from each at a point (Conty Estevez and Kulla 2018, "Importance Sampling of
//! Many Lights with Adaptive Tree Splitting"; the measure for points is pbrt-v4's, section 12.6.3).
//!
//! A node has up to eight children, whose importances are found together in vector code, where the caller's code has vectors: so these functions take part in it. A child bounds its sources: a sphere that they lie in, a
//! cone of their normals, the angle beyond which nothing is emitted, and the sum of their largest intensities. From the root down a number
//! in [0, [`Tree::share`]) is narrowed to an interval for each source: a node's interval is divided between its children by their importance. All
//! of it is integers but the quotient of a sum of importances and that of all, so a source is chosen with just the probability that it is said to be.
//!
//! A choice goes by what may arrive at the point on the side that its surface [faces](Facing): importance times a cosine. The weights of MIS, which have to
//! be found again where a BSDF's ray meets a light, from what the ray carries, go by the importance alone: quotients of the same numbers, multiplied from
//! the root down, on both sides in the same order, at least [`LEAST`].
//!
//! **Nothing is left out wrongly.** Importance is 0 only where the bounds say that no source of the child shines towards the point. The
//! angles that this is decided by are found from cosines and sines with errors below 12 roundings; an angle is the less certain the nearer
//! its cosine is to 1, at most sqrt(2 x 12 x 2^-24) < 0.0012; three of them make less than [`MARGIN`], by which the limit is moved. The sphere
//! is larger by the rounding of its centre. Whatever is not 0 gets at least as many integers as it has sources, so each of them is chosen sometimes.

use glam::DVec3;

use super::bounds::Bounds;
use super::facing::Facing;
use crate::real::{Vec3, f32, narrow, wide};

/// By which the cosine of a direction must be beyond the limit for a child to be dark there; as an angle never less than this.
const MARGIN: f64 = 1.0 / 128.0;
/// Least cosine that counts: so much may reach a point that the bounds call grazing.
const GRAZING: f32 = 1.0 / 64.0;
/// Children of a node.
const WIDTH: usize = 8;
/// Largest importance, so that those of a node have a finite sum.
const LARGEST: f32 = f32::MAX / 16.0;
/// Parts into which an axis is cut to find where to divide sources.
const BINS: usize = 12;
/// Levels after which sources are halved by number, which bounds the depth.
const DEEP: usize = 64;
/// Most levels: those, and as many as halving fewer than 2^32 sources takes, since each level divides its sources once at least.
const LEVELS: usize = DEEP + 33;
/// How far the cosine with a surface's normal is that of the part of a child's sphere that faces it most: all the way where it is several sources, which may
/// be there; of one source all of its sphere is about as likely.
const LEAN: f32 = 0.3;
/// Least weight of a source in MIS.
pub(crate) const LEAST: f32 = 1.0 / 4_294_967_296.0;
/// In a child's reference: it is a source.
const LEAF: u32 = 1 << 31;

/// A tree over sources.
#[derive(Clone, Debug)]
pub(super) struct Tree {
    /// The root first.
    nodes: Vec<Node>,
    /// By node: its place in its parent, as in `leaves`; of the root nothing.
    parents: Vec<u32>,
    /// By source: its node times [`WIDTH`] and its place there.
    leaves: Vec<u32>,
    share: u64,
}

/// What the importances of eight children are found from.
#[derive(Clone, Debug)]
#[repr(align(32))]
pub(crate) struct Node {
    center: [[f32; WIDTH]; 3],
    /// Of the sphere about `center` that holds the sources.
    radius: [f32; WIDTH],
    radius2: [f32; WIDTH],
    /// 1 / radius2.
    near: [f32; WIDTH],
    axis: [[f32; WIDTH]; 3],
    /// Of the cone about `axis` that holds all normals.
    cos_normals: [f32; WIDTH],
    sin_normals: [f32; WIDTH],
    /// At or below this cosine, of the angle from the nearest normal, it is dark.
    dark: [f32; WIDTH],
    /// 1, or [`LEAN`] of a source.
    lean: [f32; WIDTH],
    /// Sum of the largest intensities; the whole tree's is 1.
    intensity: [f32; WIDTH],
    /// Sources below; 0 where there is no child.
    count: [u32; WIDTH],
    /// A node, or a source and [`LEAF`].
    child: [u32; WIDTH],
    /// Sources below all children.
    sources: u32,
}

impl Tree {
    /// A tree over sources, of which there is at least one and fewer than 2^28; numbers below `share` choose.
    pub(super) fn new(sources: &[Bounds], share: u64) -> Tree {
        let total: f64 = sources.iter().map(|s| s.intensity).sum();
        let mut tree = Tree { nodes: Vec::new(), parents: Vec::new(), leaves: vec![0; sources.len()], share };
        let mut order: Vec<u32> = (0..sources.len() as u32).collect();
        tree.build(sources, total, &mut order, u32::MAX, 0);
        tree
    }

    /// Makes the node of some sources, and those below; its number.
    fn build(&mut self, sources: &[Bounds], total: f64, order: &mut [u32], parent: u32, depth: usize) -> u32 {
        let number = self.nodes.len();
        self.nodes.push(Node::EMPTY);
        self.parents.push(parent);
        for (slot, (part, bounds)) in parts(sources, order, depth).into_iter().enumerate() {
            let place = (number * WIDTH + slot) as u32;
            let child = match *part {
                [source] => {
                    self.leaves[source as usize] = place;
                    source | LEAF
                }
                _ => self.build(sources, total, part, place, depth + 1),
            };
            self.nodes[number].set(slot, &bounds, total, part.len(), child);
        }
        number as u32
    }

    /// The root.
    #[inline(always)]
    pub(super) fn root(&self) -> &Node {
        &self.nodes[0]
    }

    /// How many numbers choose, of 2^32.
    #[inline]
    pub(super) fn share(&self) -> u64 {
        self.share
    }

    /// Leaves nothing out that is dark at a point: it counts as if it shone there at grazing angles.
    pub(super) fn leave_out_none(&mut self) {
        for node in &mut self.nodes {
            node.dark = node.count.map(|n| if n > 0 { f32::NEG_INFINITY } else { f32::INFINITY });
        }
    }

    /// The source that a number below [`Tree::share`] chooses at a point of a surface, how many numbers choose it there, and its [weight](Tree::weight);
    /// `None` where the bounds of what is left show that it does not shine there. And whether sources were left out.
    #[inline(always)]
    pub(super) fn choose(&self, o: Vec3, facing: Facing, mut number: u64) -> (Option<(usize, u64, f32)>, bool) {
        let mut length = self.share;
        let mut node = &self.nodes[0];
        let mut fewer = false;
        let mut weight = 1.0;
        loop {
            let (importances, sum) = node.importances(o);
            let (ends, count) = node.ends(o, facing, &importances, length);
            fewer |= count < node.sources;
            if count == 0 {
                return (None, fewer);
            }
            let slot = ends.iter().filter(|&&end| end <= number).count();
            let start = if slot == 0 { 0 } else { ends[slot - 1] };
            (number, length) = (number - start, ends[slot] - start);
            weight *= importances[slot] / sum;
            let child = node.child[slot];
            if child & LEAF != 0 {
                return (Some(((child ^ LEAF) as usize, length, at_least(weight))), fewer);
            }
            node = &self.nodes[child as usize];
        }
    }

    /// What MIS takes for the probability of a source at a point: of those that shine there its share by importance; 0 where the bounds show that it does not.
    #[inline(always)]
    pub(super) fn weight(&self, o: Vec3, source: usize) -> f32 {
        let (way, levels) = self.way(source);
        let mut weight = 1.0;
        for &place in way[..levels].iter().rev() {
            let (node, slot) = (place as usize / WIDTH, place as usize % WIDTH);
            let (importances, sum) = self.nodes[node].importances(o);
            if !(importances[slot] > 0.0) {
                return 0.0;
            }
            weight *= importances[slot] / sum;
        }
        at_least(weight)
    }

    /// How many numbers choose a source at a point.
    #[cfg(test)]
    pub(super) fn numbers(&self, o: Vec3, facing: Facing, source: usize) -> u64 {
        let (way, levels) = self.way(source);
        let mut length = self.share;
        for &place in way[..levels].iter().rev() {
            let (node, slot) = (&self.nodes[place as usize / WIDTH], place as usize % WIDTH);
            let (ends, count) = node.ends(o, facing, &node.importances(o).0, length);
            if count == 0 {
                return 0;
            }
            length = ends[slot] - if slot == 0 { 0 } else { ends[slot - 1] };
            if length == 0 {
                return 0;
            }
        }
        length
    }

    /// Places of a source and of the nodes above it in theirs, and how many.
    #[inline(always)]
    fn way(&self, source: usize) -> ([u32; LEVELS], usize) {
        let mut way = [0; LEVELS];
        let mut place = self.leaves[source];
        let mut levels = 0;
        while place != u32::MAX {
            way[levels] = place;
            levels += 1;
            place = self.parents[place as usize / WIDTH];
        }
        (way, levels)
    }
}

impl Node {
    const EMPTY: Node = {
        let (zero, infinite) = ([0.0; WIDTH], [f32::INFINITY; WIDTH]);
        Node {
            center: [zero; 3],
            radius: zero,
            // every point is near it, and it is dark there
            radius2: infinite,
            near: zero,
            axis: [zero; 3],
            cos_normals: zero,
            sin_normals: zero,
            dark: infinite,
            lean: zero,
            intensity: zero,
            count: [0; WIDTH],
            child: [0; WIDTH],
            sources: 0,
        }
    };

    fn set(&mut self, slot: usize, bounds: &Bounds, total: f64, count: usize, child: u32) {
        let center = narrow(bounds.center());
        // larger by the centre's rounding and its own
        let off = (bounds.center() - wide(center)).length();
        let radius = (bounds.radius() + off) * (1.0 + 1e-6);
        let axis = narrow(bounds.axis);
        for k in 0..3 {
            (self.center[k][slot], self.axis[k][slot]) = (center[k], axis[k]);
        }
        self.radius[slot] = radius as f32;
        self.radius2[slot] = (radius * radius) as f32;
        self.near[slot] = 1.0 / self.radius2[slot];
        let angle = bounds.normals.min(std::f64::consts::PI);
        (self.cos_normals[slot], self.sin_normals[slot]) = (libm::cos(angle) as f32, libm::sin(angle) as f32);
        self.dark[slot] = (libm::cos(bounds.emission.min(std::f64::consts::PI)) - MARGIN) as f32;
        self.lean[slot] = if child & LEAF != 0 { LEAN } else { 1.0 };
        self.intensity[slot] = (bounds.intensity / total) as f32;
        (self.count[slot], self.child[slot]) = (count as u32, child);
        self.sources += count as u32;
    }

    /// How many children it has: the first ones.
    #[inline(always)]
    pub(crate) fn children(&self) -> usize {
        self.count.iter().filter(|&&n| n > 0).count()
    }

    /// The source that a child is.
    pub(super) fn source(&self, k: usize) -> Option<u32> {
        (self.count[k] == 1).then_some(self.child[k] ^ LEAF)
    }

    /// What may arrive at `o` from child `k` on a surface that faces it, roughly; 0 only if nothing does, or there is no child.
    #[inline(always)]
    pub(crate) fn importance(&self, k: usize, o: Vec3) -> f32 {
        // read whether needed or not: what is read in one branch only is gathered in vector code
        let (intensity, near) = (self.intensity[k], self.near[k]);
        let [x, y, z] = [o.x - self.center[0][k], o.y - self.center[1][k], o.z - self.center[2][k]];
        let d2 = x * x + y * y + z * z;
        let far = 1.0 / d2;
        let distance = far.sqrt();
        // of the angle between any normal and the way from its source: the largest cosine
        let cos = (self.axis[0][k] * x + self.axis[1][k] * y + self.axis[2][k] * z) * distance;
        let cos = if cos < 1.0 { cos } else { 1.0 };
        let cos = if cos > -1.0 { cos } else { -1.0 };
        let sin = (1.0 - cos * cos).sqrt();
        let (cos, sin) = less((cos, sin), (self.cos_normals[k], self.sin_normals[k]));
        let of_sphere = self.radius[k] * distance;
        let beside = 1.0 - of_sphere * of_sphere;
        let beside = if beside > 0.0 { beside.sqrt() } else { 0.0 };
        let (cos, _) = less((cos, sin), (beside, of_sphere));
        let is_beyond = d2 > self.radius2[k];
        let cos = if is_beyond { cos } else { 1.0 };
        let strength = intensity * if is_beyond { far } else { near };
        let importance = strength * if cos > GRAZING { cos } else { GRAZING };
        // NaN too becomes a number: a point that is none chooses something
        let importance = if importance > f32::MIN_POSITIVE { importance } else { f32::MIN_POSITIVE };
        let importance = if importance < LARGEST { importance } else { LARGEST };
        if cos <= self.dark[k] { 0.0 } else { importance }
    }

    /// About the cosine of the angle between a surface's normal and the way to child `k`, at least that of `facing`; 1 among the sources.
    #[inline(always)]
    pub(crate) fn faces(&self, k: usize, o: Vec3, facing: Facing) -> f32 {
        let [x, y, z] = [o.x - self.center[0][k], o.y - self.center[1][k], o.z - self.center[2][k]];
        let d2 = x * x + y * y + z * z;
        let distance = (1.0 / d2).sqrt();
        let n = facing.normal;
        let cos = -(n.x * x + n.y * y + n.z * z) * distance;
        let cos = if cos < 1.0 { cos } else { 1.0 };
        let cos = if cos > -1.0 { cos } else { -1.0 };
        let sin = (1.0 - cos * cos).sqrt();
        let of_sphere = self.radius[k] * distance;
        let beside = 1.0 - of_sphere * of_sphere;
        let beside = if beside > 0.0 { beside.sqrt() } else { 0.0 };
        // within the angle of the sphere this is above the cosine of the difference, but no more than 1
        let faces = cos * beside + self.lean[k] * sin * of_sphere;
        let faces = if d2 > self.radius2[k] { faces } else { 1.0 };
        if faces > facing.least { faces } else { facing.least }
    }

    /// Of all children, and their sum.
    #[inline(always)]
    fn importances(&self, o: Vec3) -> ([f32; WIDTH], f32) {
        let mut importances = [0.0; WIDTH];
        for k in 0..WIDTH {
            importances[k] = self.importance(k, o);
        }
        let mut sum = 0.0;
        for importance in importances {
            sum += importance;
        }
        (importances, sum)
    }

    /// Where the children's intervals of [0, `length`) end, and how many sources there are below those that shine at `o`; without any the ends
    /// mean nothing.
    #[inline(always)]
    fn ends(&self, o: Vec3, facing: Facing, importances: &[f32; WIDTH], length: u64) -> ([u64; WIDTH], u32) {
        let mut facings = [0.0; WIDTH];
        for k in 0..WIDTH {
            facings[k] = importances[k] * self.faces(k, o, facing);
        }
        let (mut sums, mut counts) = ([0.0; WIDTH], [0; WIDTH]);
        let (mut sum, mut count) = (0.0, 0);
        for k in 0..WIDTH {
            sum += facings[k];
            count += if importances[k] > 0.0 { self.count[k] } else { 0 };
            (sums[k], counts[k]) = (sum, count);
        }
        let mut ends = [0; WIDTH];
        for k in 0..WIDTH {
            ends[k] = end((sums[k], sum), (counts[k], count), length);
        }
        (ends, count)
    }
}

/// A weight that is a number above 0: products of many shares may be too small for one.
#[inline(always)]
pub(crate) fn at_least(weight: f32) -> f32 {
    if weight > LEAST { weight } else { LEAST }
}

/// Where an interval of [0, `length`) ends: importance up to there and of all, sources that shine up to there and all.
#[inline(always)]
pub(crate) fn end((part, all): (f32, f32), (before, count): (u32, u32), length: u64) -> u64 {
    // each source has one number for sure; what is dealt out is below 2^32, as there is one
    let free = length.saturating_sub(u64::from(count));
    let end = u64::from(before) + ((free * u64::from(whole(part / all * BELOW_2_32))) >> 32);
    // the last that shines ends it, whatever was rounded
    if before < count && end < length { end } else { length }
}

/// `x as u32` of a number in [0, 2^32), by operations that vectors have; of others any number.
#[inline(always)]
pub(super) fn whole(x: f32) -> u32 {
    // 2^52: the last place of a sum with it is 1
    const SHIFT: f64 = 4_503_599_627_370_496.0;
    let x = f64::from(x);
    let nearest = (x + SHIFT) - SHIFT;
    let below = if nearest > x { nearest - 1.0 } else { nearest };
    (below + SHIFT).to_bits() as u32
}

/// The largest f32 below 2^32.
const BELOW_2_32: f32 = 4_294_967_040.0;

/// Cosine and sine of the difference of two angles in [0, pi], or of 0 where the second is larger.
#[inline(always)]
fn less(a: (f32, f32), b: (f32, f32)) -> (f32, f32) {
    let is_within = a.0 > b.0;
    let (cos, sin) = (a.0 * b.0 + a.1 * b.1, a.1 * b.0 - a.0 * b.1);
    (if is_within { 1.0 } else { cos }, if is_within { 0.0 } else { sin })
}

/// Sorts sources into at most [`WIDTH`] parts with their bounds: what costs most is divided first.
fn parts<'o>(sources: &[Bounds], order: &'o mut [u32], depth: usize) -> Vec<(&'o mut [u32], Bounds)> {
    let bounds = |part: &[u32]| part.iter().map(|&i| sources[i as usize]).reduce(|a, b| a.union(&b));
    let mut out: Vec<(&mut [u32], Bounds)> = Vec::with_capacity(WIDTH);
    out.extend(bounds(order).map(|b| (order, b)));
    while out.len() < WIDTH {
        // of equal costs, as those of points in one place, the most sources
        let dear = |a: &(&mut [u32], Bounds), b: &(&mut [u32], Bounds)| {
            a.1.cost().total_cmp(&b.1.cost()).then(a.0.len().cmp(&b.0.len()))
        };
        let divisible = out.iter().enumerate().filter(|(_, p)| p.0.len() > 1);
        let Some((n, _)) = divisible.max_by(|a, b| dear(a.1, b.1)) else { break };
        let (part, whole) = out.swap_remove(n);
        let middle = if depth < DEEP { divide(sources, &whole, part) } else { None };
        let middle = middle.unwrap_or_else(|| halve(sources, &whole, part));
        let (left, right) = part.split_at_mut(middle);
        out.extend([left, right].into_iter().filter_map(|part| bounds(part).map(|b| (part, b))));
    }
    out
}

/// Sorts sources into two parts of least cost (the surface area orientation heuristic, with the squared diagonal for the area, which tells
/// points on a line apart too); the number of the first. `None` if all lie in one place, as far as the bins can tell.
fn divide(sources: &[Bounds], bounds: &Bounds, order: &mut [u32]) -> Option<usize> {
    let place = |i: u32| sources[i as usize].center();
    let (mut lo, mut hi) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for &i in &*order {
        (lo, hi) = (lo.min(place(i)), hi.max(place(i)));
    }
    let extent = bounds.hi - bounds.lo;
    let mut best: Option<(f64, usize, usize)> = None;
    let bin = |i: u32, axis: usize| {
        let x = (place(i)[axis] - lo[axis]) / (hi[axis] - lo[axis]);
        ((x * BINS as f64) as usize).min(BINS - 1)
    };
    for axis in 0..3 {
        if !(hi[axis] > lo[axis]) {
            continue;
        }
        let mut bins: [Option<Bounds>; BINS] = [None; BINS];
        let join = |a: Option<Bounds>, b: Option<Bounds>| match (a, b) {
            (Some(a), Some(b)) => Some(a.union(&b)),
            (a, b) => a.or(b),
        };
        for &i in &*order {
            let k = bin(i, axis);
            bins[k] = join(bins[k], Some(sources[i as usize]));
        }
        let mut after = [None; BINS + 1];
        for k in (0..BINS).rev() {
            after[k] = join(bins[k], after[k + 1]);
        }
        // thin boxes are better cut across than along
        let thin = extent.max_element() / extent[axis];
        let mut before = None;
        for k in 1..BINS {
            before = join(before, bins[k - 1]);
            let (Some(a), Some(b)) = (&before, &after[k]) else { continue };
            let cost = thin * (a.cost() + b.cost());
            if cost.is_finite() && best.is_none_or(|(least, ..)| cost < least) {
                best = Some((cost, axis, k));
            }
        }
    }
    let (_, axis, k) = best?;
    // stable, so that the tree depends on the order of the sources alone
    order.sort_by_key(|&i| bin(i, axis) >= k);
    Some(order.partition_point(|&i| bin(i, axis) < k))
}

/// Sorts sources along the longest side; half their number.
fn halve(sources: &[Bounds], bounds: &Bounds, order: &mut [u32]) -> usize {
    let extent = bounds.hi - bounds.lo;
    let axis = (0..3).fold(0, |best, k| if extent[k] > extent[best] { k } else { best });
    order.sort_by(|&a, &b| sources[a as usize].center()[axis].total_cmp(&sources[b as usize].center()[axis]));
    order.len() / 2
}
