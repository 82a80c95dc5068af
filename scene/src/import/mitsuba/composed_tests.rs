//! `principled`, `phong`, `blendbsdf` and `null`: what their elements become.

use super::tests::{message, scene};
use crate::description::{Amount, Bsdf, Description, Material, Slot};

fn read(bsdf: &str) -> Description {
    scene(&format!("<shape type=\"cube\">{bsdf}</shape>")).unwrap()
}

fn material(out: &Description) -> &Material {
    &out.materials[out.shapes[0].material as usize]
}

fn bad(bsdf: &str) -> String {
    message(&format!("<shape type=\"cube\">\n{bsdf}</shape>"))
}

/// What is told of a model with this inside.
fn refused(model: &str, cases: &[(&str, &str)]) {
    for (inside, what) in cases {
        let told = bad(&format!("<bsdf type=\"{model}\">{inside}</bsdf>"));
        assert!(told.contains("s.xml:3") && told.contains(what), "{told}");
    }
}

#[test]
fn principled_is_read() {
    let out = read("<bsdf type=\"principled\"/>");
    let Bsdf::Principled(p) = material(&out).bsdf else { panic!("{:?}", material(&out)) };
    assert!(p.base_color == [0.5; 3] && p.roughness == 0.5 && p.metallic == 0.0 && !material(&out).two_sided);
    // specular 0.5 is an index of 1.5
    assert!((p.eta - 1.5).abs() < 1e-6, "{}", p.eta);
    let text = "<bsdf type=\"principled\"><rgb name=\"base_color\" value=\"0.1, 0.2, 0.3\"/><float name=\"metallic\" value=\"0.7\"/>\
                <float name=\"spec_tint\" value=\"0.4\"/><float name=\"anisotropic\" value=\"0.6\"/><float name=\"sheen\" value=\"0.8\"/>\
                <float name=\"sheen_tint\" value=\"0.9\"/><float name=\"clearcoat\" value=\"0.15\"/><float name=\"clearcoat_gloss\" value=\"0.25\"/>\
                <float name=\"spec_trans\" value=\"0.35\"/><float name=\"flatness\" value=\"0.45\"/><float name=\"eta\" value=\"1\"/>\
                <texture name=\"roughness\" type=\"checkerboard\"/><float name=\"clearcoat_sampling_rate\" value=\"2\"/></bsdf>";
    let out = read(text);
    let Bsdf::Principled(p) = material(&out).bsdf else { panic!("{:?}", material(&out)) };
    assert_eq!(
        [p.metallic, p.spec_tint, p.anisotropic, p.sheen, p.sheen_tint, p.clearcoat, p.clearcoat_gloss],
        [0.7, 0.4, 0.6, 0.8, 0.9, 0.15, 0.25]
    );
    // what lets light through has no index of 1
    assert!(p.spec_trans == 0.35 && p.flatness == 0.45 && p.eta == 1.001);
    let textured = &material(&out).detail.as_ref().unwrap().textured;
    assert!(textured.len() == 1 && textured[0].slot == Slot::Roughness, "{textured:?}");
    refused(
        "principled",
        &[
            ("<float name=\"roughness\" value=\"1.5\"/>", "roughness 1.5 should lie in [0, 1]"),
            ("<float name=\"sheen\" value=\"-1\"/>", "sheen -1 should lie in [0, 1]"),
            ("<float name=\"eta\" value=\"0\"/>", "eta 0 should lie between"),
            ("<float name=\"eta\" value=\"1.4\"/><float name=\"specular\" value=\"0.4\"/>", "both eta and specular"),
            ("<float name=\"wobble\" value=\"1\"/>", "property \"wobble\" of bsdf \"principled\""),
        ],
    );
}

#[test]
fn phong_is_read() {
    let text = "<bsdf type=\"phong\"><float name=\"exponent\" value=\"80\"/><spectrum name=\"specularReflectance\" value=\"0.4\"/></bsdf>";
    let Bsdf::Phong { diffuse, specular, exponent } = material(&read(text)).bsdf else { panic!("no phong") };
    assert_eq!((diffuse, specular, exponent), ([0.5; 3], [0.4; 3], 80.0));
    refused("phong", &[("<float name=\"exponent\" value=\"-1\"/>", "exponent -1 should lie")]);
}

/// Parts lie above what they are blended to, and what stands around it reaches them.
#[test]
fn blends_are_read() {
    let inner = "<bsdf type=\"diffuse\" id=\"a\"/><bsdf type=\"blendbsdf\"><float name=\"weight\" value=\"0.25\"/>\
                 <bsdf type=\"conductor\"/><bsdf type=\"plastic\"/></bsdf>";
    let out = read(&format!(
        "<bsdf type=\"twosided\"><bsdf type=\"bumpmap\"><texture type=\"checkerboard\"/><bsdf type=\"blendbsdf\">\
         <texture name=\"weight\" type=\"checkerboard\"/>{inner}</bsdf></bsdf></bsdf>"
    ));
    let blend = material(&out).detail.as_ref().unwrap().blend.unwrap();
    assert_eq!(blend.weight, Amount::Texture(0));
    let part = |n: u32| &out.materials[n as usize];
    let (first, second) = (part(blend.parts[0]), part(blend.parts[1]));
    assert!(first.name == "a" && matches!(first.bsdf, Bsdf::Diffuse { .. }));
    let nested = second.detail.as_ref().unwrap().blend.unwrap();
    assert_eq!(nested.weight, Amount::Constant(0.25));
    let leaves = [first, part(nested.parts[0]), part(nested.parts[1])];
    for leaf in leaves {
        let relief = leaf.detail.as_ref().unwrap().relief.unwrap();
        assert!(leaf.two_sided && relief.mirrored, "{leaf:?}");
    }
    assert!(
        blend.parts.iter().all(|&n| n < out.shapes[0].material) && nested.parts.iter().all(|&n| n < blend.parts[1])
    );
    refused(
        "blendbsdf",
        &[
            ("<bsdf type=\"diffuse\"/><bsdf type=\"diffuse\"/>", "lacks its weight"),
            ("<float name=\"weight\" value=\"0.5\"/><bsdf type=\"diffuse\"/>", "needs two materials inside, and has 1"),
            (
                "<float name=\"weight\" value=\"2\"/><bsdf type=\"diffuse\"/><bsdf type=\"diffuse\"/>",
                "weight 2 should lie",
            ),
        ],
    );
}

#[test]
fn null_lets_all_pass() {
    let out = read("<bsdf type=\"null\"/>");
    assert_eq!(material(&out).detail.as_ref().unwrap().opacity, Amount::Constant(0.0));
}
