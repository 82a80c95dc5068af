//! Named metals and media: every name that Mitsuba 3.9.1 knows, with its values.
//!
//! The names are the files of its `data/ior` and the list that it prints for an unknown `int_ior`. What a metal reflects was told, in `scalar_rgb`, by
//!
//!     bsdf = mi.load_dict({"type": "conductor", "material": NAME})
//!     si = mi.SurfaceInteraction3f(); si.wi = mi.Vector3f(math.sin(angle), 0, math.cos(angle))
//!     bsdf.sample(mi.BSDFContext(), si, 0.5, [0.5, 0.5])[1]
//!
//! for angles of 30 and 75 degrees: two numbers of a channel's eta and k, which a wrong digit of either changes. The index of a medium was told by
//!
//!     mi.traverse(mi.load_dict({"type": "dielectric", "int_ior": NAME, "ext_ior": "vacuum"}))["eta"]

use super::tests::{message, scene};
use crate::description::Bsdf;

/// A metal by its name.
fn metal(name: &str) -> Bsdf {
    let text = format!(
        "<shape type=\"cube\"><bsdf type=\"conductor\"><string name=\"material\" value=\"{name}\"/></bsdf></shape>"
    );
    let out = scene(&text).unwrap_or_else(|e| panic!("{name}: {e}"));
    out.materials[out.shapes[0].material as usize].bsdf.clone()
}

/// What a mirror reflects of light that comes at an angle.
fn reflectance(mirror: &Bsdf, degrees: f32) -> [f32; 3] {
    let (sin, cos) = degrees.to_radians().sin_cos();
    let sampled = mirror.sample([sin, 0.0, cos].into(), true, [0.5; 2], 0.5).unwrap();
    sampled.delta.unwrap().to_array()
}

#[test]
fn metals_reflect_what_mitsubas_do() {
    for (name, expected) in METALS {
        let metal = metal(name);
        let found = [reflectance(&metal, 30.0), reflectance(&metal, 75.0)];
        for (found, expected) in found.as_flattened().iter().zip(expected) {
            // six digits of Mitsuba's f32
            assert!((found - expected).abs() < 3e-6, "{name}: {found} {expected}");
        }
    }
    // another name of the same measurement
    for name in PALIK {
        assert!(METALS.iter().any(|(n, _)| n == name));
        assert_eq!(metal(&format!("{name}_palik")), metal(name));
    }
    assert_eq!(METALS.len() + PALIK.len(), 71);
    for unknown in ["Xx", "au", "Au_palik", "Ag_palik", "Cu_palik_palik", "Se-o"] {
        let text = format!(
            "<shape type=\"cube\"><bsdf type=\"conductor\">\n<string name=\"material\" value=\"{unknown}\"/></bsdf></shape>"
        );
        let told = message(&text);
        assert!(told.contains("s.xml:3:1: material") && told.contains(unknown), "{told}");
    }
}

/// Whatever Mitsuba says: head-on, metals reflect what handbooks say of them (least and most of red, green and blue).
#[test]
fn metals_look_like_themselves() {
    for (name, ranges) in [
        ("Ag", [[0.95, 0.99], [0.93, 0.97], [0.88, 0.95]]),
        ("Al", [[0.90, 0.94], [0.90, 0.93], [0.90, 0.93]]),
        ("Au", [[0.94, 0.98], [0.70, 0.85], [0.30, 0.45]]),
        ("Cu", [[0.92, 0.97], [0.58, 0.70], [0.48, 0.58]]),
        ("Cr", [[0.55, 0.70]; 3]),
        ("Hg", [[0.72, 0.83]; 3]),
        ("Na_palik", [[0.92, 0.99]; 3]),
        ("Rh", [[0.70, 0.85]; 3]),
        ("W", [[0.42, 0.60]; 3]),
        // (n - 1)^2 / (n + 1)^2 of 2.42 is 0.172
        ("d-C", [[0.14, 0.22]; 3]),
    ] {
        for (found, [least, most]) in reflectance(&metal(name), 0.0).iter().zip(ranges) {
            assert!((least..=most).contains(found), "{name}: {found} is not between {least} and {most}");
        }
    }
}

#[test]
fn media_bend_light_as_mitsubas_do() {
    let eta = |name: &str| {
        let text = format!(
            "<shape type=\"cube\"><bsdf type=\"dielectric\"><string name=\"int_ior\" value=\"{name}\"/>\
             <string name=\"ext_ior\" value=\"vacuum\"/></bsdf></shape>"
        );
        let out = scene(&text).unwrap_or_else(|e| panic!("{name}: {e}"));
        let Bsdf::Dielectric { eta, .. } = out.materials[out.shapes[0].material as usize].bsdf else {
            panic!("{name}")
        };
        f64::from(eta)
    };
    for (name, expected) in MEDIA {
        // Mitsuba stores f32
        assert!((eta(name) - expected).abs() < 2e-7, "{name}: {} {expected}", eta(name));
        assert_eq!(eta(&name.to_uppercase()), eta(name));
    }
    assert_eq!(MEDIA.len(), 23);
    // and as handbooks have them for yellow light, of the pure substances among them
    for (name, handbook) in [
        ("air", 1.00028),
        ("water", 1.3330),
        ("water ice", 1.31),
        ("acetone", 1.359),
        ("ethanol", 1.361),
        ("carbon tetrachloride", 1.460),
        ("glycerol", 1.473),
        ("benzene", 1.501),
        ("fused quartz", 1.4585),
        ("sodium chloride", 1.544),
        ("diamond", 2.417),
    ] {
        assert!((eta(name) - handbook).abs() < 0.0021, "{name}: {} {handbook}", eta(name));
    }
}

/// Red, green and blue at 30 degrees, and at 75. (Of AlSb's red Mitsuba has neither index nor extinction: it is clamped out of gamut.)
type Reflectances = [f32; 6];
#[rustfmt::skip]
const METALS: &[(&str, Reflectances)] = &[
    ("a-C", [0.28009, 0.195669, 0.171108, 0.371254, 0.357408, 0.359175]),
    ("Ag", [0.974583, 0.957262, 0.906098, 0.965111, 0.956848, 0.931325]),
    ("Al", [0.927405, 0.917116, 0.918273, 0.878291, 0.8764, 0.891318]),
    ("AlAs", [0.320164, 0.278794, 0.144713, 0.371054, 0.359343, 0.321217]),
    ("AlSb", [1.0, 0.373001, 0.447081, 1.0, 0.387761, 0.421739]),
    ("Au", [0.966417, 0.80163, 0.326177, 0.959261, 0.841143, 0.495785]),
    ("Be", [0.596107, 0.519593, 0.505328, 0.527976, 0.498428, 0.502577]),
    ("Cr", [0.685978, 0.647641, 0.685722, 0.595279, 0.58903, 0.658419]),
    ("CsI", [0.134286, 0.0693553, 0.0636783, 0.317434, 0.282727, 0.277954]),
    ("Cu", [0.951652, 0.619565, 0.511147, 0.942425, 0.682539, 0.615167]),
    ("Cu2O", [0.314894, 0.246356, 0.238917, 0.369631, 0.351227, 0.355549]),
    ("Cu_palik", [0.949008, 0.621431, 0.509837, 0.939256, 0.683839, 0.6146]),
    ("CuO", [0.291104, 0.199649, 0.185125, 0.365946, 0.346609, 0.351457]),
    ("d-C", [0.213419, 0.159505, 0.146535, 0.341815, 0.326167, 0.321849]),
    ("Hg", [0.812728, 0.768959, 0.762017, 0.736569, 0.725021, 0.753615]),
    ("HgTe", [0.468878, 0.366435, 0.350971, 0.43357, 0.40902, 0.42292]),
    ("Ir", [0.74117, 0.678826, 0.629773, 0.659309, 0.635486, 0.627242]),
    ("K", [0.953831, 0.937029, 0.923396, 0.966862, 0.969493, 0.97283]),
    ("Li", [0.924279, 0.884143, 0.794237, 0.916743, 0.909695, 0.876909]),
    ("MgO", [0.126165, 0.0620265, 0.0542472, 0.314278, 0.276471, 0.268808]),
    ("Mo", [0.616695, 0.560554, 0.539839, 0.538871, 0.515765, 0.523093]),
    ("Na_palik", [0.978389, 0.959654, 0.931877, 0.977731, 0.97094, 0.962119]),
    ("Nb", [0.5628, 0.48872, 0.472595, 0.51959, 0.492852, 0.500055]),
    ("Ni_palik", [0.698713, 0.593364, 0.493676, 0.640323, 0.604445, 0.569769]),
    ("Rh", [0.823019, 0.753072, 0.720357, 0.744341, 0.696863, 0.685821]),
    ("Se", [0.378983, 0.25154, 0.242197, 0.393106, 0.358948, 0.354352]),
    ("Se-e", [0.500658, 0.402364, 0.421891, 0.441865, 0.404408, 0.417792]),
    ("SiC", [0.27167, 0.188666, 0.182202, 0.357405, 0.334952, 0.333088]),
    ("SnTe", [0.406379, 0.110242, 0.016114, 0.399564, 0.307406, 0.194572]),
    ("Ta", [0.456331, 0.342461, 0.380046, 0.508878, 0.4316, 0.439971]),
    ("Te", [0.633399, 0.576681, 0.560608, 0.528615, 0.50978, 0.540295]),
    ("Te-e", [0.708393, 0.671253, 0.651879, 0.59551, 0.583874, 0.607296]),
    ("ThF4", [0.0879904, 0.0341761, 0.027596, 0.295647, 0.241272, 0.228103]),
    ("TiC", [0.546932, 0.439258, 0.411461, 0.503127, 0.463412, 0.458811]),
    ("TiN", [0.639774, 0.453487, 0.200965, 0.631127, 0.585408, 0.438075]),
    ("TiO2", [0.304131, 0.225638, 0.238914, 0.366407, 0.345102, 0.348641]),
    ("TiO2-e", [0.26381, 0.186896, 0.196418, 0.355284, 0.334446, 0.337142]),
    ("V_palik", [0.571314, 0.509634, 0.535494, 0.509075, 0.483788, 0.521017]),
    ("VC", [0.528547, 0.417705, 0.379934, 0.492247, 0.454911, 0.444338]),
    ("VN", [0.524159, 0.392994, 0.311848, 0.510817, 0.473377, 0.44415]),
    ("W", [0.573227, 0.476956, 0.43262, 0.50898, 0.469736, 0.45388]),
];

/// Metals of which Mitsuba has a `_palik` too that is the same.
#[rustfmt::skip]
const PALIK: &[&str] = &[
    "AlAs", "AlSb", "Be", "CsI", "Cu2O", "CuO", "Hg", "HgTe", "Ir", "K", "Li", "MgO", "Mo", "Nb", "Rh", "Se", "Se-e", "SiC", "SnTe", "Ta", "Te", "Te-e", "ThF4", "TiC", "TiN", "TiO2", "TiO2-e", "VC", "VN", "d-C",
];

const MEDIA: &[(&str, f64)] = &[
    ("vacuum", 1.0),
    ("helium", 1.000_036_001),
    ("hydrogen", 1.000_131_964),
    ("air", 1.000_277_042),
    ("carbon dioxide", 1.000_450_015),
    ("water", 1.332_999_945),
    ("acetone", 1.360_000_014),
    ("ethanol", 1.360_999_942),
    ("carbon tetrachloride", 1.460_999_966),
    ("glycerol", 1.472_900_033),
    ("benzene", 1.501_000_047),
    ("silicone oil", 1.520_449_996),
    ("bromine", 1.661_000_013),
    ("water ice", 1.309_999_943),
    ("fused quartz", 1.457_999_945),
    ("pyrex", 1.470_000_029),
    ("acrylic glass", 1.490_000_010),
    ("polypropylene", 1.490_000_010),
    ("bk7", 1.504_600_048),
    ("sodium chloride", 1.544_000_030),
    ("amber", 1.549_999_952),
    ("pet", 1.575_000_048),
    ("diamond", 2.418_999_910),
];
