//! Indices of refraction of transparent media by Mitsuba's names, at 589 nm and 0 to 20 degrees Celsius (Hecht, Optics, 4th edition).

/// The index of a name, in any case.
pub(super) fn find(name: &str) -> Option<f64> {
    MEDIA.iter().find(|m| m.0.eq_ignore_ascii_case(name)).map(|m| m.1)
}

/// All names, for messages.
pub(super) fn names() -> String {
    MEDIA.iter().map(|m| m.0).collect::<Vec<_>>().join(", ")
}

const MEDIA: &[(&str, f64)] = &[
    ("vacuum", 1.0),
    ("helium", 1.000036),
    ("hydrogen", 1.000132),
    ("air", 1.000277),
    ("carbon dioxide", 1.00045),
    ("water", 1.333),
    ("acetone", 1.36),
    ("ethanol", 1.361),
    ("carbon tetrachloride", 1.461),
    ("glycerol", 1.4729),
    ("benzene", 1.501),
    ("silicone oil", 1.52045),
    ("bromine", 1.661),
    ("water ice", 1.31),
    ("fused quartz", 1.458),
    ("pyrex", 1.47),
    ("acrylic glass", 1.49),
    ("polypropylene", 1.49),
    ("bk7", 1.5046),
    ("sodium chloride", 1.544),
    ("amber", 1.55),
    ("pet", 1.575),
    ("diamond", 2.419),
];
