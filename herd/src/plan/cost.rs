//! What moving bytes, rays and time cost, in one unit: the bytes that a node reads from its own disk in that time.
//!
//! The weights are fixed, so that a plan is a function of counts and never of how fast a machine was just now.

/// A byte from another node costs as much as so many from the own disk: a link of 1 Gbit/s takes 8 ns for it, beside the
/// 2.5 ns of CPU that reading and checking a byte of a block takes anyway (measured on the chest scan of the results).
pub const REMOTE: u64 = 4;

/// A slot that stands idle for the time of tracing and shading a ray costs as much as so many bytes. That time is about a
/// microsecond (measured as above), or 400 bytes; a third of them is counted, as the work in sight is only a guess, and
/// as what moves is paid for by everyone on the network.
pub const RAY: u64 = 128;

/// Where a task does not hold the whole scene, each of its rays has the grid asked whether it may hit something elsewhere, and is kept beside
/// its candidate: 0.2 us of CPU (chest scan on 8 nodes, `--profile`), or so many bytes.
pub const WALK: u64 = 80;

/// A ray on its way is sorted into a group and packed, unpacked, traced and asked about once more: 0.9 us of CPU (measured as above), or so many
/// bytes, beside those that it moves.
pub const HOP: u64 = 360;

/// What a job's rays did so far; what is assumed before they did anything counts as some rays more.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Traffic {
    /// Camera rays made.
    camera: f64,
    /// Rays traced, camera rays among them.
    rays: f64,
    /// Rays that left their task's splits.
    hops: f64,
    /// Bytes of ray groups, one copy.
    bytes: f64,
    /// Rays, each times [`boundaries`] of the cut they were traced in.
    exposed: f64,
}

/// Rays for which the assumptions stand.
const ASSUMED: f64 = 10_000.0;

/// What of a space is boundary when it is cut into so many parts, by how many a straight line passes: the cube root of
/// their number, less the one part in which it begins. 0 for one part.
fn boundaries(parts: f64) -> f64 {
    libm::cbrt(parts) - 1.0
}

impl Traffic {
    /// Counts a task: camera rays made, rays traced in a cut into so many parts, rays that left, bytes of their groups.
    pub fn add(&mut self, camera: u64, rays: u64, parts: f64, hops: u64, bytes: u64) {
        self.camera += camera as f64;
        self.rays += rays as f64;
        self.hops += hops as f64;
        self.bytes += bytes as f64;
        self.exposed += rays as f64 * boundaries(parts);
    }
    /// Rays traced for each camera ray, itself included. Assumed: itself and one more.
    pub fn rays_per_camera(&self) -> f64 {
        (self.rays + 2.0 * ASSUMED) / (self.camera + ASSUMED)
    }
    /// Bytes of a ray on its way. Assumed: 20.
    pub fn bytes_per_hop(&self) -> f64 {
        (self.bytes + 20.0 * ASSUMED) / (self.hops + ASSUMED)
    }
    /// Hops of a ray in a cut into so many parts. Assumed: a third of what a line through the whole scene makes, as most
    /// rays are shorter.
    pub fn hops_per_ray(&self, parts: f64) -> f64 {
        (self.hops + ASSUMED / 3.0) / (self.exposed + ASSUMED) * boundaries(parts)
    }
    /// Cost of a ray's way to the node that it waits for: its CPU; a copy written here, the others elsewhere, one read there.
    pub fn hop(&self, replicas: u32) -> f64 {
        HOP as f64 + self.bytes_per_hop() * (1 + u64::from(replicas.max(1)) * REMOTE) as f64
    }
}
