//! A light tree: which of many local sources, by what may arrive from each at a point (Conty Estevez and Kulla 2018, "Importance Sampling of
//! Many Lights with Adaptive Tree Splitting"; the measure for points is pbrt-v4's, section 12.6.3).
//!
//! A node bounds its sources: a sphere that they lie in, a cone of their normals, the angle beyond which nothing is emitted, and the sum of
//! their largest intensities. From the root down a number in [0, [`Tree::share`]) is narrowed to an interval for each source: a node's
//! interval is divided between its children by their importance. All of it is integers but the quotient of two importances, which both
//! sides of MIS find in the same way from the same point, so a source is chosen with just the probability that it is said to be.
//!
//! Importance depends on the point alone, not on the normal there: the density has to be found again where a BSDF's ray meets a light, from
//! what the ray carries, which is its origin. (With the receiver's cosine too, variance was a sixth less and the time a third more.)
//!
//! **Nothing is left out wrongly.** Importance is 0 only where the bounds say that no source of the node shines towards the point. The
//! angles that this is decided by are found from cosines and sines with errors below 8 roundings; an angle is the less certain the nearer
//! its cosine is to 1, at most sqrt(2 x 8 x 2^-24) < 0.001; three of them make less than [`MARGIN`], by which the limit is moved. The sphere
//! is larger by the rounding of its centre. Whatever is not 0 gets at least as many integers as it has sources, so each of them is chosen sometimes.

use glam::{DVec3, Vec3};

use super::bounds::Bounds;

/// By which the cosine of a direction must be beyond the limit for a node to be dark there; as an angle never less than this.
const MARGIN: f64 = 1.0 / 128.0;
/// Least cosine that counts: so much may reach a point that the bounds call grazing.
const GRAZING: f32 = 1.0 / 64.0;
/// Largest importance, so that two of them have a finite sum.
const LARGEST: f32 = f32::MAX / 4.0;
/// Parts into which an axis is cut to find where to divide a node.
const BINS: usize = 12;
/// Levels after which nodes are halved by number, which bounds the depth by this and the logarithm of the number of sources.
const DEEP: usize = 64;

/// A binary tree over sources; each leaf holds one.
#[derive(Clone, Debug)]
pub(super) struct Tree {
    /// In depth-first order: the left child follows its parent.
    nodes: Vec<Node>,
    /// By source: its leaf.
    leaves: Vec<u32>,
    share: u64,
    /// Importance of what is dark: 0, by which it is left out.
    of_dark: f32,
}

/// What importance is found from.
#[derive(Clone, Copy, Debug)]
struct Node {
    center: Vec3,
    /// Squared radius of the sphere about `center` that holds the sources.
    radius2: f32,
    axis: Vec3,
    /// Of the cone about `axis` that holds all normals.
    cos_normals: f32,
    sin_normals: f32,
    /// At or below this cosine, of the angle from the nearest normal, it is dark.
    dark: f32,
    /// Sum of the largest intensities; the whole tree's is 1.
    intensity: f32,
    /// Sources below.
    count: u32,
    /// Place of the right child; 0 for a leaf.
    right: u32,
    /// A leaf's source.
    source: u32,
}

impl Tree {
    /// A tree over sources, of which there is at least one; numbers below `share` choose.
    pub(super) fn new(sources: &[Bounds], share: u64) -> Tree {
        let total: f64 = sources.iter().map(|s| s.intensity).sum();
        let mut tree =
            Tree { nodes: Vec::with_capacity(2 * sources.len()), leaves: vec![0; sources.len()], share, of_dark: 0.0 };
        let mut order: Vec<u32> = (0..sources.len() as u32).collect();
        tree.build(sources, total, &mut order, 0);
        tree
    }

    fn build(&mut self, sources: &[Bounds], total: f64, order: &mut [u32], depth: usize) {
        let bounds = order.iter().map(|&i| sources[i as usize]).reduce(|a, b| a.union(&b));
        let Some(bounds) = bounds else { return };
        let place = self.nodes.len();
        self.nodes.push(Node::new(&bounds, total, order.len()));
        if let [source] = *order {
            self.nodes[place].source = source;
            self.leaves[source as usize] = place as u32;
            return;
        }
        let middle = if depth < DEEP { divide(sources, &bounds, order) } else { None };
        let middle = middle.unwrap_or_else(|| halve(sources, &bounds, order));
        let (left, right) = order.split_at_mut(middle);
        self.build(sources, total, left, depth + 1);
        self.nodes[place].right = self.nodes.len() as u32;
        self.build(sources, total, right, depth + 1);
    }

    /// How many numbers choose, of 2^32.
    #[inline]
    pub(super) fn share(&self) -> u64 {
        self.share
    }

    /// Leaves nothing out that is dark at a point: it is chosen as little as may be.
    pub(super) fn leave_out_none(&mut self) {
        self.of_dark = f32::MIN_POSITIVE;
    }

    /// The source that a number below [`Tree::share`] chooses at a point, and how many numbers choose it there; `None` where the
    /// bounds of what is left show that it does not shine there. And whether sources were left out.
    #[inline]
    pub(super) fn choose(&self, o: Vec3, mut number: u64) -> (Option<(usize, u64)>, bool) {
        let mut length = self.share;
        let mut at = 0;
        let mut fewer = false;
        loop {
            let node = &self.nodes[at];
            if node.right == 0 {
                return (Some((node.source as usize, length)), fewer);
            }
            let Some(left) = self.left_part(o, at, node.right as usize, length) else { return (None, true) };
            // both have a number at least where both shine
            fewer |= (left == 0) | (left == length);
            if number < left {
                (at, length) = (at + 1, left);
            } else {
                number -= left;
                (at, length) = (node.right as usize, length - left);
            }
        }
    }

    /// How many numbers choose a source at a point.
    #[inline]
    pub(super) fn numbers(&self, o: Vec3, source: usize) -> u64 {
        let leaf = self.leaves[source] as usize;
        let mut length = self.share;
        let mut at = 0;
        while at != leaf {
            let right = self.nodes[at].right as usize;
            let Some(left) = self.left_part(o, at, right, length) else { return 0 };
            (at, length) = if leaf < right { (at + 1, left) } else { (right, length - left) };
            if length == 0 {
                return 0;
            }
        }
        length
    }

    /// Of `length` numbers those of the left child of the node at `at`; `None` if neither child shines at `o`.
    #[inline]
    fn left_part(&self, o: Vec3, at: usize, right: usize, length: u64) -> Option<u64> {
        let (l, r) = (&self.nodes[at + 1], &self.nodes[right]);
        let (a, b) = (l.importance(o, self.of_dark), r.importance(o, self.of_dark));
        match (a > 0.0, b > 0.0) {
            (false, false) => None,
            (false, true) => Some(0),
            (true, false) => Some(length),
            (true, true) => {
                // below 2^32, so the product stays below 2^64
                let part = ((a / (a + b)) * 4_294_967_296.0) as u64;
                let left = (length * part.min(u64::from(u32::MAX))) >> 32;
                Some(left.max(u64::from(l.count)).min(length.saturating_sub(u64::from(r.count))))
            }
        }
    }
}

impl Node {
    fn new(bounds: &Bounds, total: f64, count: usize) -> Node {
        let center = bounds.center().as_vec3();
        // larger by the centre's rounding and its own
        let off = (bounds.center() - center.as_dvec3()).length();
        let radius = (bounds.radius() + off) * (1.0 + 1e-6);
        let angle = bounds.normals.min(std::f64::consts::PI);
        let dark = libm::cos(bounds.emission.min(std::f64::consts::PI)) - MARGIN;
        Node {
            center,
            radius2: (radius * radius) as f32,
            axis: bounds.axis.as_vec3(),
            cos_normals: libm::cos(angle) as f32,
            sin_normals: libm::sin(angle) as f32,
            dark: dark as f32,
            intensity: (bounds.intensity / total) as f32,
            count: count as u32,
            right: 0,
            source: 0,
        }
    }

    /// What may arrive at `o` on a surface that faces it, roughly; `of_dark` only if nothing does.
    #[inline]
    #[expect(clippy::manual_clamp, reason = "clamp leaves NaN as it is")]
    fn importance(&self, o: Vec3, of_dark: f32) -> f32 {
        let to = o - self.center;
        let d2 = to.length_squared();
        let cos = if d2 > self.radius2 { self.largest_cos(to, d2) } else { 1.0 };
        if cos <= self.dark {
            return of_dark;
        }
        let importance = self.intensity * cos.max(GRAZING) / d2.max(self.radius2);
        // NaN too becomes a number: a point that is none chooses something
        importance.max(f32::MIN_POSITIVE).min(LARGEST)
    }

    /// Of the angle between any normal and the way from its source to a point beyond the sphere at `to` from the centre: the largest cosine.
    #[inline]
    fn largest_cos(&self, to: Vec3, d2: f32) -> f32 {
        let cos = (self.axis.dot(to) / d2.sqrt()).clamp(-1.0, 1.0);
        let sin = (1.0 - cos * cos).sqrt();
        let sphere = self.radius2 / d2;
        let (cos, sin) = less((cos, sin), (self.cos_normals, self.sin_normals));
        less((cos, sin), ((1.0 - sphere).max(0.0).sqrt(), sphere.sqrt())).0
    }
}

/// Cosine and sine of the difference of two angles in [0, pi], or of 0 where the second is larger.
#[inline]
fn less(a: (f32, f32), b: (f32, f32)) -> (f32, f32) {
    if a.0 > b.0 { (1.0, 0.0) } else { (a.0 * b.0 + a.1 * b.1, a.1 * b.0 - a.0 * b.1) }
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
