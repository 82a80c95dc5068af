use glam::{DVec3, Vec3};

use super::*;
use crate::testing::{Rng, chi_square};

/// Directions where rounding is delicate: axes, diagonals, ties within a few ulps, tiny components.
fn delicate() -> Vec<Vec3> {
    let mut out = Vec::new();
    let values = [0.0, 1e-30, 1e-12, 3e-10, 1e-9, 0.03, 0.5, 1.0 - 6e-8, 1.0, 1.0 + 1.2e-7, 2.0];
    for x in values {
        for y in values {
            for z in values {
                let v = Vec3::new(x, y, z);
                if v.length() > 0.1 {
                    for s in 0..8 {
                        let sign = |b: i32| if s >> b & 1 == 0 { 1.0 } else { -1.0 };
                        out.push(v.normalize() * Vec3::new(sign(0), sign(1), sign(2)));
                    }
                }
            }
        }
    }
    out
}

#[test]
fn directions_come_back() {
    let mut rng = Rng(1);
    let random = (0..1_000_000).map(|_| rng.direction());
    let mut worst = 0.0f64;
    for d in delicate().into_iter().chain(random) {
        let code = UnitDir::encode(d.to_array());
        let e = code.decode();
        assert_eq!(UnitDir::encode(e).decode().map(f32::to_bits), e.map(f32::to_bits), "{d}");
        let (a, b) = (d.as_dvec3(), DVec3::from(e.map(f64::from)));
        assert!((b.length() - 1.0).abs() < 6e-8, "{d}: length {}", b.length());
        worst = worst.max(a.cross(b).length() / a.length());
        assert_eq!(UnitDir::from_words(code.to_words()), Some(code), "{d}");
    }
    println!("worst error {worst} rad");
    assert!(worst < 1e-7, "{worst}");
}

#[test]
fn any_code_decodes_and_bad_ones_are_found() {
    let mut rng = Rng(2);
    let mut valid = 0;
    for _ in 0..100_000 {
        let words = [rng.u32(), rng.u32()];
        if let Some(d) = UnitDir::from_words(words) {
            valid += 1;
            let v = d.decode();
            assert!((Vec3::from(v).length() - 1.0).abs() < 1e-6);
            assert_eq!(UnitDir::encode(v).decode(), v);
        }
    }
    assert!(valid > 5000 && valid < 60_000, "{valid}");
    assert_eq!(UnitDir::from_words([3 << 30, 0]), None);
    assert_eq!(UnitDir::from_words([0, 1 << 31]), None);
}

#[test]
fn frames_are_orthonormal() {
    let mut rng = Rng(3);
    for n in delicate().into_iter().chain((0..100_000).map(|_| rng.direction()).collect::<Vec<_>>()) {
        let tangent = n.yzx() + n * 0.5;
        for b in [
            Basis::new(n),
            Basis::with_tangent(n, tangent),
            Basis::with_tangent(n, n),
            Basis::with_tangent(n, Vec3::ZERO),
        ] {
            for (x, y, e) in [(b.s, b.s, 1.0), (b.t, b.t, 1.0), (b.s, b.t, 0.0), (b.s, b.n, 0.0), (b.t, b.n, 0.0)] {
                assert!((x.dot(y) - e).abs() < 2e-6, "{n} {b:?}");
            }
            assert!((b.s.cross(b.t) - b.n).length() < 2e-6);
            let v = Vec3::new(0.3, -0.4, 0.5);
            assert!((b.to_local(b.to_world(v)) - v).length() < 2e-6);
        }
    }
}

trait Swizzle {
    fn yzx(self) -> Self;
}
impl Swizzle for Vec3 {
    fn yzx(self) -> Vec3 {
        Vec3::new(self.y, self.z, self.x)
    }
}

#[test]
fn sine_and_cosine() {
    let mut worst = 0.0f64;
    for i in 0..=1_000_000 {
        let u = i as f32 / 1_000_000.0;
        let (s, c) = sincos_turn(u);
        let x = 2.0 * std::f64::consts::PI * f64::from(u);
        worst = worst.max((f64::from(s) - libm::sin(x)).abs()).max((f64::from(c) - libm::cos(x)).abs());
    }
    println!("worst {worst}");
    assert!(worst < 2e-7, "{worst}");
}

#[test]
fn angles() {
    let mut worst = 0.0f64;
    let mut look = |y: f32, x: f32| {
        worst = worst.max((f64::from(atan2(y, x)) - libm::atan2(f64::from(y), f64::from(x))).abs());
    };
    for i in 0..=1_000_000 {
        let x = 2.0 * std::f64::consts::PI * f64::from(i) / 1e6;
        look(libm::sin(x) as f32, libm::cos(x) as f32);
    }
    let odd = [0.0, -0.0, 1.0, -1.0, 1e-30, -1e-30, 1e-44, -1e-44, 1e30, -1e30, 0.414_213_57, 0.414_213_5];
    for y in odd {
        odd.iter().for_each(|x| look(y, *x));
    }
    println!("worst {worst}");
    assert!(worst < 4e-7, "{worst}");
}

/// The disk is covered evenly: equal counts in bins of equal area by radius and angle.
#[test]
fn disk_is_uniform() {
    let mut counts = vec![0.0; 160];
    let n = 400;
    for i in 0..n {
        for j in 0..n {
            let [x, y] = concentric_disk([(i as f32 + 0.5) / n as f32, (j as f32 + 0.5) / n as f32]);
            let (x, y) = (f64::from(x), f64::from(y));
            let r2 = x * x + y * y;
            assert!(r2 < 1.0);
            let ring = ((r2 * 10.0) as usize).min(9);
            let phi = y.atan2(x) / (2.0 * std::f64::consts::PI) + 0.5;
            counts[ring * 16 + ((phi * 16.0) as usize).min(15)] += 1.0;
        }
    }
    let expected = vec![f64::from(n * n) / 160.0; 160];
    chi_square(&counts, &expected);
    assert_eq!(concentric_disk([0.5, 0.5]), [0.0, 0.0]);
}

/// In f64: the moved origin lies strictly on the side of the normal, by at least the bound of the ray test's own error, and not farther than
/// some hundred ulps of what is there.
#[test]
fn origins_leave_the_plane() {
    let mut rng = Rng(4);
    for _ in 0..200_000 {
        let far = [0.0, 1.0, 100.0][(rng.u32() % 3) as usize];
        let size = [1e-3, 1.0, 50.0][(rng.u32() % 3) as usize];
        let (p0, e1, e2) = {
            let p0 = rng.vec3(far);
            let (p1, p2) = (p0 + rng.vec3(size), p0 + rng.vec3(size));
            (p0, p1 - p0, p2 - p0)
        };
        let n = e1.as_dvec3().cross(e2.as_dvec3());
        if n.length() < 1e-4 * e1.as_dvec3().length() * e2.as_dvec3().length() {
            continue;
        }
        let n = n.normalize() * if rng.u32() & 1 == 0 { 1.0 } else { -1.0 };
        let (mut u, mut v) = (rng.f32(), rng.f32());
        if u + v > 1.0 {
            (u, v) = (1.0 - u, 1.0 - v);
        }
        let at = Position::on_triangle(p0, e1, e2, u, v);
        let o = offset_origin(&at, n.as_vec3());
        let height = (o.as_dvec3() - p0.as_dvec3()).dot(n);
        assert!(height > 0.0, "{height} {at:?}");
        let scale = f64::from(p0.abs().max_element().max(e1.abs().max_element()).max(e2.abs().max_element()));
        assert!(height < 1e-5 * scale, "{height} of {scale}");
    }
}
