//! Rules that the API server checks at apply, in CEL: where in the schema, what must hold, what to do.
//!
//! The server refuses a definition whose rules could cost too much, which it estimates from the bounds of the schema: whatever a rule
//! walks over has `maxItems` or `maxLength`, and none walks over a list for each of its elements.

/// A part of the schema (`items` is what a list holds), a rule, and what is said where it does not hold.
pub type Rule = (&'static [&'static str], &'static str, &'static str);

/// A field that stays as it was, or stays away.
macro_rules! same {
    ($field:literal) => {
        concat!(
            "has(self.",
            $field,
            ") == has(oldSelf.",
            $field,
            ") && (!has(self.",
            $field,
            ") || self.",
            $field,
            " == oldSelf.",
            $field,
            ")"
        )
    };
}

const SPEC: &[&str] = &["spec"];
const SCENE: &[&str] = &["spec", "scene"];
const LIGHT: &[&str] = &["spec", "scene", "lights", "items"];
const IMAGE: &[&str] = &["spec", "image"];
const CAMERA: &[&str] = &["spec", "image", "cameras", "items"];
const SAMPLING: &[&str] = &["spec", "sampling"];
const WORKERS: &[&str] = &["spec", "workers"];
const STORAGE: &[&str] = &["spec", "storage"];

/// All of them.
pub const RULES: &[Rule] = &[
    (SPEC, "!(has(self.blockSize) && has(self.splits))", "give blockSize or splits, not both"),
    (SPEC, same!("blockSize"), "spec.blockSize cannot be changed: make another job"),
    (SPEC, same!("splits"), "spec.splits cannot be changed: make another job"),
    // what is written already would keep the copies that it has
    (SPEC, same!("replicas"), "spec.replicas cannot be changed: make another job"),
    (SPEC, same!("overlapThreshold"), "spec.overlapThreshold cannot be changed: make another job"),
    (
        SPEC,
        "!has(self.scene.prepared) || !(has(self.blockSize) || has(self.splits))",
        "spec.scene.prepared is cut already: leave out blockSize and splits",
    ),
    (SPEC, same!("managedBy"), "spec.managedBy cannot be changed: make another job"),
    (
        SCENE,
        "has(self.prepared) || (has(self.source) && self.source.trim() != '')",
        "spec.scene.source is empty: name a scene in the storage",
    ),
    (SCENE, "!(has(self.prepared) && has(self.source))", "give spec.scene.source or spec.scene.prepared, not both"),
    (
        SCENE,
        "!has(self.prepared) || !(has(self.iso) || has(self.lights) || has(self.sky) || has(self.albedo) || has(self.define) || self.substitute)",
        "spec.scene.prepared is imported already: leave out iso, lights, sky, albedo, define and substitute",
    ),
    (
        SCENE,
        "!has(self.source) || (!self.source.contains('://') && !self.source.startsWith('/') && !self.source.split('/').exists(p, p.startsWith('.')))",
        "spec.scene.source is a key in the job's storage, such as scenes/room/room.xml",
    ),
    (SCENE, "self == oldSelf", "the scene of a job cannot be changed: make another job"),
    (
        SCENE,
        "!has(self.sky) || self.sky.size() != 2",
        "spec.scene.sky has one number, or three for red, green and blue",
    ),
    (
        SCENE,
        "!has(self.albedo) || self.albedo.size() != 2",
        "spec.scene.albedo has one number, or three for red, green and blue",
    ),
    (LIGHT, "self.target != self.origin", "a light's target is its origin: choose a point that its front looks at"),
    (LIGHT, "self.size.all(x, x > 0.0)", "a light's size is a width and a height above 0"),
    (LIGHT, "self.radiance.size() != 2", "a light's radiance has one number, or three for red, green and blue"),
    (
        IMAGE,
        "!has(self.output) || (self.output.endsWith('.exr') && self.output.size() > 4 && !self.output.startsWith('/') && !self.output.split('/').exists(p, p.startsWith('.')))",
        "spec.image.output ends in .exr and is a relative path",
    ),
    (
        IMAGE,
        "!has(self.prefix) || (self.prefix.split('/').all(p, p != '' && !p.startsWith('.')) && !(self.prefix.split('/')[0] in ['deleted', 'going', 'jobs', 'names', 'objects', 'uses']))",
        "spec.image.prefix is a relative path such as shots/room, and not in deleted, going, jobs, names, objects or uses, which are Rayherd's own",
    ),
    (IMAGE, same!("size"), "spec.image.size cannot be changed: make another job"),
    (IMAGE, same!("cameras"), "spec.image.cameras cannot be changed: make another job"),
    (IMAGE, same!("aovs"), "spec.image.aovs cannot be changed: make another job"),
    (IMAGE, same!("output"), "spec.image.output cannot be changed: copy the picture, or make another job"),
    (IMAGE, same!("prefix"), "spec.image.prefix cannot be changed: copy the picture, or make another job"),
    (CAMERA, "self.target != self.origin", "a camera's target is its origin: choose a point that it looks at"),
    (
        SAMPLING,
        "!has(self.targetError) || self.targetError > 0.0",
        "spec.sampling.targetError is above 0, such as 0.01",
    ),
    (
        SAMPLING,
        "!has(self.targetError) || (has(oldSelf.targetError) && self.targetError <= oldSelf.targetError)",
        "spec.sampling.targetError can be lowered or taken away only: make another job that ends earlier",
    ),
    (SAMPLING, "!has(self.timeLimit) || self.timeLimit > 0.0", "spec.sampling.timeLimit is above 0, in seconds"),
    (
        SAMPLING,
        "!has(self.spp) || !has(oldSelf.spp) || self.spp >= oldSelf.spp",
        "spec.sampling.spp can be raised only: make another job for fewer samples",
    ),
    (
        SAMPLING,
        "(has(self.seed) ? self.seed : 0) == (has(oldSelf.seed) ? oldSelf.seed : 0)",
        "the seed of a job cannot be changed: make another job",
    ),
    (SAMPLING, same!("maxDepth"), "spec.sampling.maxDepth cannot be changed: make another job"),
    (SAMPLING, same!("rrDepth"), "spec.sampling.rrDepth cannot be changed: make another job"),
    (
        SAMPLING,
        "(has(self.split) ? self.split : 1) == (has(oldSelf.split) ? oldSelf.split : 1)",
        "spec.sampling.split cannot be changed: make another job",
    ),
    (WORKERS, "has(self.min) == has(self.max)", "give spec.workers.min and max together"),
    (WORKERS, "!has(self.min) || !has(self.max) || self.min <= self.max", "spec.workers.min is at most max"),
    (WORKERS, "!has(self.nodes) || !has(self.max)", "give spec.workers.nodes, or min and max"),
    (
        WORKERS,
        "!has(self.max) || !has(self.slots) || self.slots.size() < 2",
        "with min and max, spec.workers.slots has one number",
    ),
    (
        WORKERS,
        "!has(self.slots) || self.slots.size() < 2 || !has(self.nodes) || self.slots.size() == self.nodes",
        "spec.workers.slots has one number for all workers, or one for each",
    ),
    (STORAGE, "self == oldSelf", "the storage of a job cannot be changed: make another job"),
];

#[cfg(test)]
mod tests;
