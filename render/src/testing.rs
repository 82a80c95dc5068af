//! Helpers of this crate's tests: plain random numbers and the chi-square test.

use glam::Vec3;

use crate::math::hash::mix64;

/// SplitMix64.
pub struct Rng(pub u64);

impl Rng {
    pub fn u64(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        mix64(self.0)
    }
    pub fn u32(&mut self) -> u32 {
        (self.u64() >> 32) as u32
    }
    /// In [0, 1).
    pub fn f32(&mut self) -> f32 {
        (self.u64() >> 40) as f32 / 16_777_216.0
    }
    pub fn f64(&mut self) -> f64 {
        (self.u64() >> 11) as f64 / 9_007_199_254_740_992.0
    }
    pub fn range(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.f32()
    }
    /// Uniform over the unit sphere.
    pub fn direction(&mut self) -> Vec3 {
        loop {
            let v = Vec3::new(self.range(-1.0, 1.0), self.range(-1.0, 1.0), self.range(-1.0, 1.0));
            let l = v.length_squared();
            if l > 0.01 && l < 1.0 {
                return v / l.sqrt();
            }
        }
    }
    pub fn vec3(&mut self, size: f32) -> Vec3 {
        Vec3::new(self.range(-size, size), self.range(-size, size), self.range(-size, size))
    }
}

/// Checks counts against expected counts: chi-square at a level of about 1e-5 (Wilson-Hilferty), bins of fewer than five expected pooled.
#[track_caller]
pub fn chi_square(observed: &[f64], expected: &[f64]) {
    let (mut sum, mut bins) = (0.0, 0);
    let (mut pooled_o, mut pooled_e) = (0.0, 0.0);
    for (&o, &e) in observed.iter().zip(expected) {
        if e < 5.0 {
            pooled_o += o;
            pooled_e += e;
        } else {
            sum += (o - e) * (o - e) / e;
            bins += 1;
        }
    }
    if pooled_e > 5.0 {
        sum += (pooled_o - pooled_e) * (pooled_o - pooled_e) / pooled_e;
        bins += 1;
    } else {
        assert!(pooled_o - pooled_e < 30.0, "{pooled_o} in bins where {pooled_e} are expected");
    }
    assert!(bins > 1, "no bins to compare");
    let k = f64::from(bins - 1);
    let z = ((sum / k).cbrt() - (1.0 - 2.0 / (9.0 * k))) / (2.0 / (9.0 * k)).sqrt();
    assert!(z < 4.3, "chi-square {sum} with {k} degrees of freedom, z = {z}");
}

/// Bin of a direction, of equal solid angle: `n` by z, `2 n` by azimuth.
pub fn sphere_bin(d: Vec3, n: usize) -> usize {
    let z = ((0.5 * (f64::from(d.z) + 1.0) * n as f64) as usize).min(n - 1);
    let phi = f64::from(d.y).atan2(f64::from(d.x)) / (2.0 * std::f64::consts::PI) + 0.5;
    z * 2 * n + ((phi * 2.0 * n as f64) as usize).min(2 * n - 1)
}

/// Integral of a density over each bin of [`sphere_bin`], by `k` x `k` midpoints.
pub fn integrate_bins(n: usize, k: usize, density: impl Fn(Vec3) -> f64) -> Vec<f64> {
    let mut out = vec![0.0; 2 * n * n];
    let area = 4.0 * std::f64::consts::PI / (2 * n * n * k * k) as f64;
    for i in 0..n * k {
        let z = -1.0 + 2.0 * (i as f64 + 0.5) / (n * k) as f64;
        let r = (1.0 - z * z).sqrt();
        for j in 0..2 * n * k {
            let phi = ((j as f64 + 0.5) / (2 * n * k) as f64 - 0.5) * 2.0 * std::f64::consts::PI;
            let d = Vec3::new((r * phi.cos()) as f32, (r * phi.sin()) as f32, z as f32);
            out[i / k * 2 * n + j / k] += density(d) * area;
        }
    }
    out
}
