//! A room with any number of small lamps, as Mitsuba XML (version 3): to see how light choice scales.

use std::fmt::Write;

/// Most lamps of one room.
pub const MOST_LAMPS: u32 = 100_000;

/// A room of 4 x 2 x 4 with partitions, a checkered floor and a metal ball, under `lamps` (1 to [`MOST_LAMPS`]) small one-sided squares: places at
/// random below ceiling and walls' upper halves, radiances log-normal (sigma 1.6), so that a few lamps have most of the power; all of them together
/// emit as much whatever their number. Lamps and numbers are the same every time.
pub fn many_lights(lamps: u32) -> String {
    let lamps = lamps.clamp(1, MOST_LAMPS);
    let mut random = Random(0x5eed);
    let mut out = ROOM.to_owned();
    // side of a lamp: all lamps together cover a hundredth of the ceiling at most
    let side = 0.02f64.min(0.4 / f64::from(lamps).sqrt());
    let radiances: Vec<f64> = (0..lamps).map(|_| libm::exp(1.6 * random.normal())).collect();
    let total = radiances.iter().sum::<f64>() * 4.0 * side * side;
    for radiance in radiances {
        let (x, z) = (random.between(-1.95, 1.95), random.between(-1.95, 1.95));
        // on the ceiling, or on one of two walls
        let turn = match random.below(4) {
            0 => format!(
                r#"<rotate y="1" angle="90"/><translate x="-1.99" y="{:.6}" z="{z:.6}"/>"#,
                random.between(1.0, 1.9)
            ),
            1 => format!(
                r#"<rotate y="1" angle="-90"/><translate x="1.99" y="{:.6}" z="{z:.6}"/>"#,
                random.between(1.0, 1.9)
            ),
            _ => format!(r#"<rotate x="1" angle="90"/><translate x="{x:.6}" y="1.99" z="{z:.6}"/>"#),
        };
        let light = 8.0 * radiance / total;
        let [r, g, b] = [1.0, random.between(0.7, 1.0), random.between(0.5, 1.0)].map(|c| light * c);
        // writing to a string cannot fail
        let _ = writeln!(
            out,
            r#"<shape type="rectangle"><transform name="to_world"><scale value="{side:.6}"/>{turn}</transform><bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf><emitter type="area"><rgb name="radiance" value="{r:.6}, {g:.6}, {b:.6}"/></emitter></shape>"#
        );
    }
    out.push_str("</scene>\n");
    out
}

/// SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }
    fn below(&mut self, n: u64) -> u64 {
        self.next() % n
    }
    fn between(&mut self, lo: f64, hi: f64) -> f64 {
        lo + (hi - lo) * ((self.next() >> 11) as f64 / (1u64 << 53) as f64)
    }
    /// Box and Muller's.
    fn normal(&mut self) -> f64 {
        let (u, v) = (self.between(0.0, 1.0), self.between(0.0, 1.0));
        libm::sqrt(-2.0 * libm::log(1.0 - u)) * libm::cos(std::f64::consts::TAU * v)
    }
}

const ROOM: &str = r#"<scene version="3.0.0">
<!-- made by `rayherd scene many-lights` -->
<default name="spp" value="64"/><default name="res" value="256"/><default name="max_depth" value="8"/>
<integrator type="path"><integer name="max_depth" value="$max_depth"/></integrator>
<sensor type="perspective"><float name="fov" value="65"/>
<transform name="to_world"><lookat origin="1.6, 1.5, 1.8" target="-0.3, 0.6, -0.6" up="0, 1, 0"/></transform>
<sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
<film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/><rfilter type="box"/></film></sensor>
<bsdf type="twosided" id="wall"><bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.68, 0.64"/></bsdf></bsdf>
<bsdf type="twosided" id="tiles"><bsdf type="diffuse"><texture name="reflectance" type="checkerboard">
<rgb name="color0" value="0.15, 0.16, 0.2"/><rgb name="color1" value="0.7, 0.7, 0.7"/>
<transform name="to_uv"><scale x="8" y="8"/></transform></texture></bsdf></bsdf>
<bsdf type="roughconductor" id="metal"><string name="material" value="Cu"/><float name="alpha" value="0.2"/></bsdf>
<shape type="rectangle"><transform name="to_world"><scale value="2"/><rotate x="1" angle="-90"/></transform><ref id="tiles"/></shape>
<shape type="rectangle"><transform name="to_world"><scale value="2"/><rotate x="1" angle="90"/><translate y="2"/></transform><ref id="wall"/></shape>
<shape type="cube"><transform name="to_world"><scale x="2" y="1" z="0.01"/><translate y="1" z="-2"/></transform><ref id="wall"/></shape>
<shape type="cube"><transform name="to_world"><scale x="2" y="1" z="0.01"/><translate y="1" z="2"/></transform><ref id="wall"/></shape>
<shape type="cube"><transform name="to_world"><scale x="0.01" y="1" z="2"/><translate x="-2.01" y="1"/></transform><ref id="wall"/></shape>
<shape type="cube"><transform name="to_world"><scale x="0.01" y="1" z="2"/><translate x="2.01" y="1"/></transform><ref id="wall"/></shape>
<shape type="cube"><transform name="to_world"><scale x="0.02" y="0.6" z="0.7"/><translate x="-0.9" y="0.6" z="-1.2"/></transform><ref id="wall"/></shape>
<shape type="cube"><transform name="to_world"><scale x="0.7" y="0.5" z="0.02"/><translate x="0.9" y="0.5" z="-0.7"/></transform><ref id="wall"/></shape>
<shape type="sphere"><point name="center" x="-0.2" y="0.35" z="-0.2"/><float name="radius" value="0.35"/><ref id="metal"/></shape>
<shape type="cube"><transform name="to_world"><scale value="0.25"/><rotate y="1" angle="30"/><translate x="0.7" y="0.25" z="0.3"/></transform><ref id="wall"/></shape>
"#;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::import::{ImportOptions, import};

    #[test]
    fn rooms_are_read_and_shine_alike() {
        let folder = tempfile::tempdir().unwrap();
        let mut powers = Vec::new();
        for lamps in [1, 100, 1000] {
            let text = many_lights(lamps);
            assert!(text == many_lights(lamps));
            let path = folder.path().join("room.xml");
            std::fs::write(&path, text).unwrap();
            let room = import(&path, &ImportOptions::default()).unwrap();
            let emissions = room.shapes.iter().filter_map(|s| s.emission);
            assert_eq!(emissions.clone().count(), lamps as usize);
            let side = 0.02f64.min(0.4 / f64::from(lamps).sqrt());
            powers.push(emissions.map(|e| f64::from(e[0])).sum::<f64>() * 4.0 * side * side);
        }
        assert!(powers.iter().all(|p| (p / 8.0 - 1.0).abs() < 1e-3), "{powers:?}");
    }
}
