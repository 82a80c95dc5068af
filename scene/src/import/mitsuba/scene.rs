//! The root: its children in source order, and the integrator.

use super::Converter;
use super::xml::malformed;
use crate::ImportError;

/// Integrators that estimate the full light transport: the same image as path tracing.
const FULL_TRANSPORT: &[&str] = &[
    "path",
    "volpath",
    "volpathmis",
    "volpath_simple",
    "bdpt",
    "mlt",
    "pssmlt",
    "ppm",
    "sppm",
    "erpt",
    "ptracer",
    "prb",
    "prb_basic",
    "prb_projective",
    "prbvolpath",
    "path_guiding_integrator",
    "path_tracing_integrator_py",
    "guided_path",
];

impl Converter<'_> {
    pub(super) fn scene(&mut self) -> Result<(), ImportError> {
        let root = 0;
        for (_, id) in self.nested(root, "sensor")?.into_iter().take(1) {
            self.sensor(id)?;
        }
        for (_, id) in self.nested(root, "sensor")?.into_iter().skip(1) {
            let object = &self.document.objects[id];
            let name = object.id.as_deref().unwrap_or(&object.plugin);
            tracing::warn!("{}: sensor \"{name}\" is left out: the first of a scene's sensors is used", object.place);
        }
        for (_, id) in self.nested(root, "integrator")? {
            self.integrator(id)?;
        }
        // materials first, so that their numbers follow the file whoever refers to them
        for (property, id) in self.nested(root, "bsdf")? {
            self.material(id, &property.place)?;
        }
        for (_, id) in self.nested(root, "emitter")? {
            self.scene_emitter(id)?;
        }
        for (property, id) in self.nested(root, "shape")? {
            self.shape(id, &property.place)?;
        }
        // named media, textures and the like matter only where they are used
        for class in ["texture", "medium", "phase", "volume", "spectrum"] {
            self.nested(root, class)?;
        }
        self.leave(root);
        Ok(())
    }

    fn integrator(&mut self, id: usize) -> Result<(), ImportError> {
        let object = &self.document.objects[id];
        let place = &object.place;
        self.out.max_depth = match self.integer(id, "max_depth")? {
            None | Some(-1) => None,
            Some(n) => match u32::try_from(n) {
                Ok(n) => Some(n),
                Err(_) => return malformed(place, "max_depth should be -1 (unbounded) or at least 0"),
            },
        };
        self.out.rr_depth = match self.integer(id, "rr_depth")? {
            None => None,
            Some(n) => match u32::try_from(n) {
                Ok(n) if n > 0 => Some(n),
                _ => return malformed(place, "rr_depth should be at least 1"),
            },
        };
        match object.plugin.as_str() {
            "path" => {}
            plugin if FULL_TRANSPORT.contains(&plugin) => {
                tracing::info!(integrator = plugin, "rendered by path tracing, which estimates the same image");
                for p in &object.properties {
                    // settings of another algorithm for the same image
                    if p.name != "hide_emitters" {
                        p.used.set(true);
                    }
                }
            }
            "direct" => self.out.max_depth = Some(2),
            plugin => {
                self.unsupported(place, format!("integrator \"{plugin}\""), "path tracing");
                if self.options.substitute {
                    object.properties.iter().for_each(|p| p.used.set(true));
                }
            }
        }
        self.ignore(id, &["strict_normals", "samples_per_pass", "block_size", "timeout"]);
        self.out.hide_emitters = self.boolean(id, "hide_emitters")?.unwrap_or(false);
        self.leave(id);
        Ok(())
    }
}
