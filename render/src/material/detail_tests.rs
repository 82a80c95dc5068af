//! Textures reach the parameter that their slot names, and no other.

use serde_json::Value;

use super::tests::{clear_plastic, glass, rough, rough_plastic};
use super::*;
use crate::math::luminance;
use crate::texture::{At, Checkerboard, NoTextures, Texture, UvMap};

/// What each texture gives in place of one parameter.
const COLOR: [f32; 3] = [0.9, 0.3, 0.6];
/// What its colour is multiplied by.
const SCALE: [f32; 3] = [0.5, 1.0, 0.25];

const SLOTS: [Slot; 16] = [
    Slot::Diffuse,
    Slot::Specular,
    Slot::Transmit,
    Slot::Alpha,
    Slot::AlphaU,
    Slot::AlphaV,
    Slot::Roughness,
    Slot::Anisotropic,
    Slot::Metallic,
    Slot::SpecTrans,
    Slot::SpecTint,
    Slot::Sheen,
    Slot::SheenTint,
    Slot::Clearcoat,
    Slot::ClearcoatGloss,
    Slot::Flatness,
];

/// Fields of a model that a slot gives.
type Given = (Slot, &'static [&'static str]);

/// Every model, and which of its fields each slot gives (two for the roughness along both); slots that are not named give nothing.
fn models() -> Vec<(Bsdf, Vec<Given>)> {
    use Slot::*;
    let white = [1.0; 3];
    let glossy: [Given; 3] = [(Alpha, &["alpha/0", "alpha/1"]), (AlphaU, &["alpha/0"]), (AlphaV, &["alpha/1"])];
    let through: [Given; 2] = [(Specular, &["reflect"]), (Transmit, &["transmit"])];
    let coated: [Given; 2] = [(Diffuse, &["diffuse"]), (Specular, &["specular"])];
    let metal: [Given; 1] = [(Specular, &["specular"])];
    let principled = Principled {
        base_color: white,
        eta: 1.5,
        roughness: 1.0,
        anisotropic: 1.0,
        metallic: 1.0,
        spec_trans: 1.0,
        spec_tint: 1.0,
        sheen: 1.0,
        sheen_tint: 1.0,
        clearcoat: 1.0,
        clearcoat_gloss: 1.0,
        flatness: 1.0,
    };
    let of_principled: [Given; 11] = [
        (Diffuse, &["base_color"]),
        (Roughness, &["roughness"]),
        (Anisotropic, &["anisotropic"]),
        (Metallic, &["metallic"]),
        (SpecTrans, &["spec_trans"]),
        (SpecTint, &["spec_tint"]),
        (Sheen, &["sheen"]),
        (SheenTint, &["sheen_tint"]),
        (Clearcoat, &["clearcoat"]),
        (ClearcoatGloss, &["clearcoat_gloss"]),
        (Flatness, &["flatness"]),
    ];
    vec![
        (Bsdf::Diffuse { reflectance: white }, vec![(Diffuse, &["reflectance"])]),
        (Bsdf::Conductor { eta: white, k: white, specular: white }, metal.to_vec()),
        (rough(Distribution::Ggx, [1.0; 2]), [&metal[..], &glossy].concat()),
        (Bsdf::Dielectric { eta: 1.5, reflect: white, transmit: white }, through.to_vec()),
        (Bsdf::ThinDielectric { eta: 1.5, reflect: white, transmit: white }, through.to_vec()),
        (glass(Distribution::Beckmann, [1.0; 2], 1.5), [&through[..], &glossy].concat()),
        (clear_plastic(1.5, 1.0, false), coated.to_vec()),
        (rough_plastic(Distribution::Ggx, 1.0, 1.5, 1.0, true), coated.to_vec()),
        (Bsdf::Phong { diffuse: white, specular: white, exponent: 30.0 }, coated.to_vec()),
        (Bsdf::Principled(principled), of_principled.to_vec()),
        (Bsdf::Principled(Principled { anisotropic: 0.0, ..principled }), of_principled.to_vec()),
    ]
}

/// A model's fields by name, as they are stored: an independent list of them.
fn fields(bsdf: &Bsdf) -> Value {
    let Value::Object(variant) = serde_json::to_value(bsdf).unwrap() else { panic!("{bsdf:?}") };
    variant.into_iter().next().unwrap().1
}

/// For every model and every slot: the fields that the table names get the texture's value, all others stay; where blocks of vertices take
/// the model, they take the same.
#[test]
fn a_texture_reaches_its_parameter_alone() {
    let squares = Checkerboard { to_uv: UvMap::IDENTITY, colors: [COLOR; 2] };
    let textures = [Texture::Checkerboard(squares)];
    let at = At::uv([0.3, 0.8]);
    let number = Value::from(luminance(COLOR.into()) * SCALE[0]);
    let color = serde_json::to_value([0, 1, 2].map(|c| COLOR[c] * SCALE[c])).unwrap();
    let (mut reached, mut looked) = (0, 0);
    for (bsdf, known) in models() {
        for slot in SLOTS {
            let textured = vec![Textured { slot, texture: 0, scale: SCALE }];
            let detail = Detail { textured, ..Detail::default() };
            let mut material = Material::new("", bsdf.clone(), true);
            material.detail = Some(Box::new(detail.clone()));
            let found = material.at(&detail, &textures, &NoTextures, at);
            let mut expected = fields(&bsdf);
            for name in known.iter().filter(|(s, _)| *s == slot).flat_map(|(_, names)| *names) {
                let field =
                    expected.pointer_mut(&format!("/{name}")).unwrap_or_else(|| panic!("{bsdf:?} has no {name}"));
                *field = if field.is_array() { color.clone() } else { number.clone() };
                reached += 1;
            }
            assert_eq!(fields(&found), expected, "{slot:?} of {bsdf:?}");
            if let Some(kind) = material.kind() {
                assert_eq!(Kind::ALL[kind.number()], kind);
                let look = material.look(&textures, &NoTextures, at, &textures[0].spot(at));
                let even = Material::new("", found, true).even_look();
                assert_eq!(format!("{look:?}"), format!("{even:?}"), "{slot:?}");
                looked += 1;
            }
        }
    }
    // diffuse 1, metals 1 + 1, glasses 3 x 2, coats and phong 3 x 2, rough ones 2 x (2 + 1 + 1), principled 2 x 11
    assert_eq!(reached, 1 + 2 + 6 + 6 + 8 + 22);
    // diffuse, rough plastic, rough metal and rough glass, without the two slots that make a lobe anisotropic; principled without three
    assert_eq!(looked, 4 * 14 + 13);
}
