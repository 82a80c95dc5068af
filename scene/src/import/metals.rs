//! Measured indices of refraction by Mitsuba's names.
//!
//! The values are those that Mitsuba 3.9.1 computes in its RGB mode from the spectra that it ships (as `eta.value` and `k.value`
//! of a `conductor` say), so that a named metal is the same here and there. Sources of the spectra: Palik's Handbook of
//! Optical Constants of Solids, and SOPRA.

/// A conductor's index of refraction, per channel of linear Rec. 709.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Metal {
    name: &'static str,
    /// Real part.
    pub eta: [f32; 3],
    /// Imaginary part.
    pub k: [f32; 3],
}

/// The metal of a name; `X_palik` is `X` where the two are one measurement. `X-e` is a crystal's extraordinary ray.
pub(super) fn find(name: &str) -> Option<Metal> {
    let by_name = |name: &str| METALS.iter().find(|m| m.name == name).copied();
    let twice = |m: &Metal| !NOT_PALIK.contains(&m.name) && !m.name.ends_with("_palik");
    by_name(name).or_else(|| by_name(name.strip_suffix("_palik")?).filter(twice))
}

/// Metals without a measurement of this name's suffix.
const NOT_PALIK: &[&str] = &["a-C", "Ag", "Al", "Au", "Cr", "W"];

#[rustfmt::skip]
const METALS: &[Metal] = &[
    Metal { name: "a-C", eta: [2.9440458, 2.2271364, 1.9681617], k: [0.8874649, 0.7992985, 0.81529] },
    Metal { name: "Ag", eta: [0.1552762, 0.116727956, 0.13838764], k: [4.8283544, 3.1222224, 2.1469011] },
    Metal { name: "Al", eta: [1.6575009, 0.8804047, 0.52124447], k: [9.223811, 6.269502, 4.837004] },
    Metal { name: "AlAs", eta: [3.605296, 3.2329378, 2.2163186], k: [0.0006794373, 0.0, 0.007512709] },
    Metal { name: "AlSb", eta: [0.0, 4.1393747, 4.6692543], k: [0.0, 0.09400908, 1.30057] },
    Metal { name: "Au", eta: [0.14303598, 0.37530708, 1.4420453], k: [3.982997, 2.3855565, 1.6033592] },
    Metal { name: "Be", eta: [4.1850123, 3.1850293, 2.7840612], k: [3.835466, 3.0101223, 2.868994] },
    Metal { name: "Cr", eta: [4.3696675, 2.9165053, 1.6549046], k: [5.206547, 4.231306, 3.7546988] },
    Metal { name: "CsI", eta: [2.1448996, 1.7023189, 1.6624272], k: [0.0, 0.0, 0.0] },
    Metal { name: "Cu", eta: [0.20100547, 0.9237495, 1.1022154], k: [3.9132621, 2.4530451, 2.1420898] },
    Metal { name: "Cu_palik", eta: [0.21322851, 0.9197154, 1.1024108], k: [3.9218733, 2.4573317, 2.136584] },
    Metal { name: "Cu2O", eta: [3.5517726, 2.9498696, 2.7518754], k: [0.11420702, 0.19389686, 0.6061339] },
    Metal { name: "CuO", eta: [3.247541, 2.4478052, 2.2102196], k: [0.52108955, 0.57003075, 0.72217894] },
    Metal { name: "d-C", eta: [2.7087197, 2.3188257, 2.2288976], k: [0.0, 0.0, 0.0] },
    Metal { name: "Hg", eta: [2.3989387, 1.440028, 0.9095704], k: [6.327587, 4.371925, 3.4217637] },
    Metal { name: "HgTe", eta: [4.77904, 3.2311962, 2.6599011], k: [1.6316127, 1.5808104, 1.7292874] },
    Metal { name: "Ir", eta: [3.0863, 2.0821905, 1.6179146], k: [5.592153, 4.067088, 3.267312] },
    Metal { name: "K", eta: [0.06404319, 0.046409767, 0.038184915], k: [2.1041996, 1.34894, 0.9131259] },
    Metal { name: "Li", eta: [0.26579094, 0.19561832, 0.22094862], k: [3.540155, 2.3111234, 1.6686072] },
    Metal { name: "MgO", eta: [2.0895839, 1.6507235, 1.594879], k: [4.3326952e-12, 0.0, 2.4986457e-11] },
    Metal { name: "Mo", eta: [4.483974, 3.5251307, 2.7763104], k: [4.1114373, 3.420827, 3.1506073] },
    Metal { name: "Na_palik", eta: [0.060269356, 0.056140948, 0.061988432], k: [3.1792734, 2.1124904, 1.5790411] },
    Metal { name: "Nb", eta: [3.420074, 2.7900932, 2.3956294], k: [3.4413946, 2.7376661, 2.5797458] },
    Metal { name: "Ni_palik", eta: [2.3673046, 1.6633731, 1.4670781], k: [4.4988117, 3.050153, 2.3454392] },
    Metal { name: "Rh", eta: [2.5857935, 1.8602164, 1.5542634], k: [6.7822604, 4.702987, 3.976073] },
    Metal { name: "Se", eta: [4.0583115, 2.842935, 2.8208535], k: [0.75404954, 0.6384435, 0.52180755] },
    Metal { name: "Se-e", eta: [5.722849, 4.165736, 4.0813384], k: [0.8711363, 1.1051575, 1.5653203] },
    Metal { name: "SiC", eta: [3.1723416, 2.5259717, 2.4793706], k: [7.5376636e-07, 0.0, 1.0192531e-05] },
    Metal { name: "SnTe", eta: [4.5242496, 1.981645, 1.2815913], k: [0.0, 0.0, 0.0] },
    Metal { name: "Ta", eta: [2.062721, 2.3929389, 2.6279287], k: [2.4083598, 1.7414864, 1.9470278] },
    Metal { name: "Te", eta: [7.3902335, 4.482105, 2.637106], k: [3.2560222, 3.5270588, 3.2920542] },
    Metal { name: "Te-e", eta: [7.508907, 4.2964287, 2.3699877], k: [5.5839286, 4.947205, 3.9975922] },
    Metal { name: "ThF4", eta: [1.8307136, 1.4422286, 1.3876476], k: [0.0, 0.0, 0.0] },
    Metal { name: "TiC", eta: [3.7005284, 2.8374221, 2.582287], k: [3.265635, 2.3515892, 2.1727905] },
    Metal { name: "TiN", eta: [1.6484497, 1.150516, 1.3798234], k: [3.368328, 1.9434981, 1.1020677] },
    Metal { name: "TiO2", eta: [3.45661, 2.8017359, 2.905175], k: [0.00010526484, 0.0, 0.0006528865] },
    Metal { name: "TiO2-e", eta: [3.1065645, 2.5131683, 2.5824444], k: [2.9751605e-05, 0.0, 0.00018269809] },
    Metal { name: "VC", eta: [3.657566, 2.752736, 2.532672], k: [3.0683007, 2.1986873, 1.9631927] },
    Metal { name: "V_palik", eta: [4.277582, 3.5129488, 2.7610714], k: [3.4913008, 2.8894548, 3.111522] },
    Metal { name: "VN", eta: [2.8656023, 2.119189, 1.9400911], k: [3.0322425, 2.0561156, 1.6163063] },
    Metal { name: "W", eta: [4.3708167, 3.3002465, 2.9984074], k: [3.5006406, 2.604874, 2.2732332] },
];
