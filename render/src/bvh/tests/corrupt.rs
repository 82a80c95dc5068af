//! Geometry objects that are wrong: named errors, no panic, and whatever passes can be traced.

use rayherd_tests::mutation;

use super::super::block::HEADER;
use super::super::layout::*;
use super::super::testing::*;
use super::super::{BlockError, Forest, ForestError};
use super::{balls, rays_for, soup};
use crate::ray::Ray;

fn sample(random: &mut Random) -> (Vec<Triangle>, Vec<u8>) {
    let triangles = soup(random, 150, 1.0, 0.2);
    let spheres = balls(random, 20, 0.5);
    let object = block(&triangles, &spheres);
    (triangles, object)
}

fn error(object: &[u8]) -> BlockError {
    let mut forest = Forest::new(1 << 22).unwrap();
    match forest.insert(object) {
        Err(ForestError::Block(e)) => e,
        other => panic!("{other:?}"),
    }
}

#[test]
fn each_kind_of_damage_is_named() {
    let mut random = Random::new(20);
    let (_, good) = sample(&mut random);
    let root = HEADER;
    let child_ref = |object: &[u8], leaf: bool| {
        (0..WIDTH)
            .map(|s| root + NODE_REFS + s * 4)
            .find(|&at| read_u32(object, at) != 0 && (read_u32(object, at) & LEAF != 0) == leaf)
    };
    let inner = child_ref(&good, false).expect("the root has an inner child");
    let with = |change: &dyn Fn(&mut Vec<u8>)| {
        let mut object = good.clone();
        change(&mut object);
        error(&object).to_string()
    };
    let says = |text: String, part: &str| assert!(text.contains(part), "{text:?} does not say {part:?}");
    says(with(&|o| o.truncate(100)), "shorter than its header");
    says(with(&|o| o.clear()), "shorter than its header");
    says(with(&|o| o[0] = 0), "does not begin as one");
    says(with(&|o| write_u32(o, 8, 3)), "version 3");
    says(with(&|o| o.push(0)), "its length");
    says(with(&|o| write_u32(o, 12, u32::MAX)), "more primitives");
    says(with(&|o| write_u32(o, 12, 151)), "primitives are missing");
    says(with(&|o| write_u32(o, 12, 149)), "out of range");
    says(with(&|o| write_u32(o, 76, u32::MAX)), "its length");
    says(with(&|o| write_u32(o, 20, 2)), "root is not where");
    says(with(&|o| write_u32(o, 24, 0)), "root is not where");
    says(with(&|o| write_u32(o, 28, 7)), "coding of ids is unknown");
    says(with(&|o| write_u32(o, 32, 3)), "another stack");
    says(with(&|o| write_f32(o, 40, -9.0)), "bounds");
    says(with(&|o| write_f32(o, 64, 1.0)), "bounds");
    says(with(&|o| o[90] = 1), "reserved field");
    // to itself, to the node before, past the end, to a leaf
    says(with(&|o| write_u32(o, inner, 0)), "an empty slot has a box");
    says(with(&|o| write_u32(o, inner, OFFSET)), "does not lead to the next record");
    says(with(&|o| write_u32(o, inner, read_u32(&good, inner) + 2)), "does not lead to the next record");
    says(with(&|o| write_u32(o, inner, LEAF | read_u32(&good, inner))), "does not lead to the next record");
    let slot = (inner - root - NODE_REFS) / 4;
    says(with(&|o| write_f32(o, root + slot * 4, f32::NAN)), "a box is not finite");
    says(with(&|o| write_f32(o, root + slot * 4, f32::NEG_INFINITY)), "a box is not finite");
    says(with(&|o| write_f32(o, root + slot * 4, 0.9)), "a box");
    // the first leaf in the order of the records
    let mut node = root;
    let leaf = loop {
        let refs: Vec<u32> = (0..WIDTH).map(|s| read_u32(&good, node + NODE_REFS + s * 4)).collect();
        if let Some(leaf) = refs.iter().find(|&&r| r & LEAF != 0 && leaf_len(r) > 1) {
            break *leaf;
        }
        node = HEADER + offset(*refs.iter().find(|&&r| r != 0 && r & LEAF == 0).unwrap());
    };
    let (at, n) = (HEADER + offset(leaf), leaf_len(leaf));
    let index = at + INDEX_ROW * n * 4;
    says(with(&|o| write_u32(o, index, 150)), "out of range or order");
    says(with(&|o| write_u32(o, index, read_u32(&good, index + 4))), "out of range or order");
    says(with(&|o| write_f32(o, at, f32::NAN)), "a triangle passes the bounds");
    says(with(&|o| write_f32(o, at, 5.0)), "a triangle passes the bounds");
    let far = |o: &mut Vec<u8>| (0..3).for_each(|vertex| write_f32(o, at + 3 * vertex * n * 4, read_f32(&good, 52)));
    says(with(&far), "a box does not meet its triangles");
    let other = read_u32(&good, index);
    let free = (0..read_u32(&good, index + 4)).find(|&i| i != other).unwrap();
    says(with(&|o| write_u32(o, index, free)), "primitives are missing");
}

#[test]
fn no_damage_makes_it_panic_or_read_elsewhere() {
    let mut random = Random::new(21);
    let (triangles, good) = sample(&mut random);
    let rays: Vec<Ray> = rays_for(&mut random, &triangles, 60, 1.0);
    let mut tracers = kernels();
    let mut passed = 0;
    let rounds = mutation::rounds("geometry", 3000, |seed| {
        let mut random = Random::new(seed.bits());
        let mut object = good.clone();
        for _ in 0..=random.below(3) {
            damage(&mut random, &mut object);
        }
        let mut forest = Forest::new(1 << 22).unwrap();
        // beside a good block, so that a reference that leads astray meets other records
        if random.below(2) == 0 {
            forest.insert(&good).unwrap();
        }
        let Ok(handle) = forest.insert(&object) else { return };
        passed += u64::from(object != good);
        forest.finish().unwrap();
        let expected: Vec<_> = closest(&mut tracers[0], &forest, &rays);
        for tracer in &mut tracers[1..] {
            assert_eq!(closest(tracer, &forest, &rays), expected);
            any(tracer, &forest, &rays);
        }
        for hit in expected.iter().filter(|h| h.is_hit()) {
            forest.primitive(hit);
            forest.prim_id(hit.prim);
        }
        assert!(forest.remove(handle));
    });
    println!("{passed} of {rounds:?} damaged objects passed the check");
}

/// One change: of a bit, a word, a word for another, a cut, or more bytes.
fn damage(random: &mut Random, object: &mut Vec<u8>) {
    const WORDS: [u32; 10] =
        [0, 1, u32::MAX, 0x8000_0000, 0x7f80_0000, 0xff80_0000, 0x7fc0_0000, 0x0fff_ffff, 0x3f80_0000, 0x7f7f_ffff];
    let len = object.len();
    let word = |random: &mut Random| random.below(len / 4) * 4;
    match random.below(12) {
        0 => object.truncate(random.below(len + 1)),
        1 => object.extend(vec![0; random.below(200)]),
        2..5 => {
            let at = random.below(HEADER.min(len.max(1)));
            if let Some(byte) = object.get_mut(at) {
                *byte ^= 1 << random.below(8);
            }
        }
        _ if len < 4 => {}
        5 => {
            let (a, b) = (word(random), word(random));
            let value = read_u32(object, a);
            write_u32(object, b, value);
        }
        6 | 7 => {
            let (at, value) = (word(random), WORDS[random.below(WORDS.len())]);
            write_u32(object, at, value);
        }
        8 => {
            let at = word(random);
            let value = read_u32(object, at).wrapping_add(random.below(5) as u32).wrapping_sub(2);
            write_u32(object, at, value);
        }
        _ => {
            let at = random.below(len);
            object[at] ^= 1 << random.below(8);
        }
    }
}
