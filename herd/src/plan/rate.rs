//! How many rays make a task of so many seconds: measured, and of no effect on the image.

/// Rays and camera rays per second of a slot, from the tasks that were committed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rate {
    rays: Mean,
    camera: Mean,
}

/// Count and seconds; older tasks fade, so that the figure follows the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Mean {
    count: f64,
    seconds: f64,
}

impl Mean {
    fn add(&mut self, count: u64, seconds: f64) {
        self.count = 0.9 * self.count + count as f64;
        self.seconds = 0.9 * self.seconds + seconds;
    }
    fn of(&self, seconds: f64) -> u64 {
        let count = self.count / self.seconds * seconds;
        // a cast of a float saturates; 2^40 rays are a day's work for any slot
        if count.is_finite() { (count as u64).clamp(1, 1 << 40) } else { 1 }
    }
}

impl Rate {
    /// What is assumed before anything is measured: careful, so that the first tasks are short rather than long.
    pub const UNKNOWN: Rate =
        Rate { rays: Mean { count: 200_000.0, seconds: 0.5 }, camera: Mean { count: 20_000.0, seconds: 0.5 } };

    /// Counts a task: seconds, rays traced, and camera rays among them, which bring the others with them.
    pub fn add(&mut self, seconds: f64, rays: u64, camera: u64) {
        self.rays.add(rays, seconds);
        if camera > 0 {
            self.camera.add(camera, seconds);
        }
    }
    /// Rays of a task of so many seconds, at least 1.
    pub fn rays(&self, seconds: f64) -> u64 {
        self.rays.of(seconds)
    }
    /// Camera rays of a task of so many seconds, at least 1.
    pub fn camera(&self, seconds: f64) -> u64 {
        self.camera.of(seconds)
    }
}
