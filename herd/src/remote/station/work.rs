//! What a worker does with a piece of work.

use tokio::runtime::Handle;

use super::super::Depot;
use super::super::bands::Adder;
use super::super::blocks::build_blocks;
use super::super::homes::Homes;
use super::super::message::{Done, Stage, Work};
use super::super::prepare::prepare_scene;
use super::super::traffic::Traffic;
use super::{Opened, Station};
use crate::job::{JobError, PreparedScene};
use crate::local::attempt::{self, Attempt};
use crate::local::slots::StopFlag;
use crate::store::object_key;
use crate::task::Stop;

impl Station<'_> {
    pub(super) fn done(&self, work: &Work, open: Option<&Opened>, stop: &StopFlag) -> Result<Done, JobError> {
        let not_open = || JobError::Internal("work of a stage that is not open".into());
        let open = || open.map(|o| (o.stage, &o.shared)).ok_or_else(not_open);
        match work {
            Work::Prepare { spec, replicas, apart, .. } => {
                // handed out to a worker that was told to leave meanwhile
                stop.check()?;
                prepare_scene(self.place(), spec, *replicas, apart.as_ref(), &self.scratch)
            }
            Work::Build { prefix, splits, replicas } => {
                let alone = self.takes_all_threads(work);
                let blocks = build_blocks(self.place(), prefix, splits, *replicas, alone, stop)?;
                tracing::info!(splits = blocks.len(), "blocks built");
                Ok(Done::Built { blocks })
            }
            Work::Attempt { attempt } => {
                let (_, shared) = open()?;
                let attempt = Attempt { node: self.node(), ..attempt.clone() };
                let made = attempt::run(shared, &attempt, stop)?;
                let attempt::Made { outputs, hops, skipped, profile, .. } = made;
                Ok(Done::Made { outputs, hops, skipped, profile: profile.map(Box::new) })
            }
            Work::Merge { name, parts, spp, picture, band, tiles } => {
                let (stage, shared) = open()?;
                let read = self.reads_film(stage, shared, stop);
                let adder = Adder { layout: stage.frame.layout(), band: stage.band, read: &read };
                match picture {
                    Some(key) => self.picture(&adder, (stage, shared), parts, spp, (key, stop)),
                    None => self.merge(&adder, shared, name.as_deref(), (parts, *band), (spp, *tiles)),
                }
            }
            Work::Preview { parts, spp, key, exposure } => {
                let (stage, shared) = open()?;
                let read = self.reads_film(stage, shared, stop);
                let adder = Adder { layout: stage.frame.layout(), band: stage.band, read: &read };
                self.preview(&adder, parts, spp, (key, *exposure), stop)
            }
            Work::Copy { objects, gone } => {
                let (_, shared) = open()?;
                let mut copied = Vec::new();
                for (name, holders) in objects {
                    stop.check()?;
                    let now = shared.nodes.copy_elsewhere(name, holders, *gone)?;
                    copied.extend(now.map(|holders| (name.clone(), holders)));
                }
                Ok(Done::Copied { objects: copied })
            }
            Work::Restore { gone } => {
                let (stage, shared) = open()?;
                self.restore(stage, shared.scene, *gone, stop)
            }
        }
    }

    /// Copies of the scene's objects that lay on a store which is silent, made again where there is one.
    fn restore(&self, stage: &Stage, scene: &PreparedScene, gone: u32, stop: &StopFlag) -> Result<Done, JobError> {
        let (count, replicas, m) = (self.depot.len(), stage.replicas, &scene.manifest);
        let homes = Homes::of(scene, count, replicas);
        let splits = m.splits.iter().zip(homes.splits()).filter(|(_, on)| on.contains(&gone));
        let tiles = (0..).zip(&m.tiles).filter(|(n, _)| homes.tile(*n).contains(&gone));
        // what belongs to no place may be anywhere
        let others = [&m.world, &stage.scene].into_iter().chain(&m.sky_map);
        let objects = splits.flat_map(|(s, _)| [&s.geometry, &s.attributes]).chain(tiles.map(|t| t.1)).chain(others);
        let store = self.depot.replicated(replicas)?;
        let (mut copies, mut few) = (0, 0);
        for object in objects {
            stop.check()?;
            let (copied, enough) = self.runtime.block_on(store.replicated().keep_up(&object_key(&object.hash)));
            copies += copied;
            few += u64::from(!enough);
        }
        Ok(Done::Restored { copies, few })
    }

    /// Where preparing works.
    fn place(&self) -> (&Depot, &Handle, &Traffic) {
        (&self.depot, self.runtime.handle(), &self.traffic)
    }

    /// Our place among the stores; one past them when none is here.
    pub(super) fn node(&self) -> u32 {
        self.depot.home().unwrap_or(self.depot.len())
    }
}
