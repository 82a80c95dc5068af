//! Parts of the film added up: to other parts, to previews and to the picture.

use std::io::BufWriter;
use std::ops::Range;
use std::path::Path;

use rayherd_render::film::{ErrorSum, Samples};

use super::super::bands::Adder;
use super::super::message::{Done, Stage};
use super::Station;
use crate::job::JobError;
use crate::job::spec::definition;
use crate::ledger::FilmRef;
use crate::local::attempt::Shared;
use crate::local::slots::StopFlag;
use crate::png_file;
use crate::report::Kind;
use crate::store::StoreError;
use crate::task::{Stop, codec};

impl Station<'_> {
    pub(super) fn reads_film<'a>(
        &'a self,
        stage: &'a Stage,
        shared: &'a Shared,
        stop: &'a StopFlag,
    ) -> impl Fn(&FilmRef) -> Result<Vec<u8>, JobError> + 'a {
        move |part| {
            stop.check()?;
            let open = |body: &bytes::Bytes| codec::open_film(stage.frame.layout(), body);
            shared.nodes.get(self.node(), Kind::Film, &part.key, &part.holders, open)
        }
    }

    pub(super) fn merge(
        &self,
        adder: &Adder,
        shared: &Shared,
        name: Option<&str>,
        (parts, band): (&[FilmRef], Option<u32>),
        (spp, tiles): (&Samples, bool),
    ) -> Result<Done, JobError> {
        let sum = adder.sum(parts, band)?;
        let film = match name {
            Some(key) if !sum.is_empty() => {
                let body = codec::seal_film(&sum.encode());
                let bytes = body.len() as u64;
                let holders = shared.nodes.put(self.node(), Kind::Film, key, body)?;
                Some(FilmRef { key: key.to_owned(), band, bytes, holders })
            }
            _ => None,
        };
        let non_finite = sum.rejected().keys.iter().copied().collect();
        let errors = sum.tile_errors(spp);
        let error = errors.as_deref().map(ErrorSum::total);
        let errors = errors.filter(|_| tiles).unwrap_or_default();
        let of_band = band.map_or(0..errors.len(), |b| {
            let Range { start, end } = adder.tiles(b);
            errors.len().min(start as usize)..errors.len().min(end as usize)
        });
        Ok(merged(adder, film, (error, errors[of_band].to_vec()), non_finite, Vec::new()))
    }

    /// Makes a PNG of a film that is not finished, in a file of our own, then puts it on the stores that take it.
    pub(super) fn preview(
        &self,
        adder: &Adder,
        parts: &[FilmRef],
        spp: &Samples,
        (key, exposure): (&str, f64),
        stop: &StopFlag,
    ) -> Result<Done, JobError> {
        let io = |e| self.no_room(e);
        std::fs::create_dir_all(&self.scratch).map_err(io)?;
        let file = tempfile::NamedTempFile::new_in(&self.scratch).map_err(io)?;
        let mut rows = png_file::Rows::new(file.reopen().map_err(io)?, adder.layout.size, exposure).map_err(io)?;
        adder.show(parts, spp, |row| {
            stop.check()?;
            rows.add(row).map_err(io)
        })?;
        rows.finish().and_then(|()| png_file::check_end(file.as_file())).map_err(io)?;
        for store in self.depot.stores() {
            stop.check()?;
            if let Err(e) = self.runtime.block_on(store.put_file(key, file.path())) {
                tracing::warn!("no preview: {e}");
            }
        }
        Ok(Done::Previewed)
    }

    /// Makes a picture in a file of our own, and the PNG beside it, then puts those that are wanted on the stores that take them.
    pub(super) fn picture(
        &self,
        adder: &Adder,
        (stage, shared): (&Stage, &Shared),
        parts: &[FilmRef],
        spp: &Samples,
        (key, stop): (&str, &StopFlag),
    ) -> Result<Done, JobError> {
        let io = |e| self.no_room(e);
        std::fs::create_dir_all(&self.scratch).map_err(io)?;
        // gone with the value
        let file = tempfile::NamedTempFile::new_in(&self.scratch).map_err(io)?;
        let definition = definition(&shared.scene.manifest, shared.frame, spp)?;
        let offset = shared.scene.manifest.offset;
        let shown = tempfile::NamedTempFile::new_in(&self.scratch).map_err(io)?;
        let rows = |e| png_file::Rows::new(shown.reopen()?, shared.frame.size, e);
        let mut rows = stage.exposure.map(rows).transpose().map_err(io)?;
        let seen = |row: &[[f32; 3]]| rows.as_mut().map_or(Ok(()), |r| r.add(row)).map_err(io);
        let totals = adder.picture(parts, spp, offset, &definition, BufWriter::new(file.as_file()), seen)?;
        let beside =
            rows.map(|r| r.finish().and_then(|()| png_file::check_end(shown.as_file())).map_err(io)).transpose()?;
        let beside = beside.map(|()| (format!("{}.png", key.strip_suffix(".exr").unwrap_or(key)), shown.path()));
        // the PNG first: where the EXR is, it stands beside it
        let files: Vec<(String, &Path)> =
            beside.into_iter().chain(stage.exr.then(|| (key.to_owned(), file.path()))).collect();
        let main = files.last().map_or(key, |(key, _)| key);
        let mut at = Vec::new();
        let mut error: Option<StoreError> = None;
        // on every store, so that each of them shows it
        for store in self.depot.stores() {
            stop.check()?;
            let put = async {
                for (key, file) in &files {
                    store.put_file(key, file).await?;
                }
                Ok(())
            };
            match self.runtime.block_on(put) {
                Ok(()) => at.push(format!("{}/{main}", store.describe())),
                Err(e) => {
                    tracing::warn!("{e}");
                    error = Some(e);
                }
            }
        }
        match error {
            Some(e) if at.is_empty() => Err(e.into()),
            _ => Ok(merged(adder, None, (totals.error, Vec::new()), totals.non_finite.into_iter().collect(), at)),
        }
    }

    fn no_room(&self, e: std::io::Error) -> JobError {
        JobError::Settings(format!("cannot write a picture in {}: {e}; give it room", self.scratch.display()))
    }
}

/// What came out of adding up. The mean is for operators that know no bands.
fn merged(
    adder: &Adder,
    film: Option<FilmRef>,
    (error, tiles): (Option<ErrorSum>, Vec<ErrorSum>),
    non_finite: Vec<(u32, u32)>,
    picture: Vec<String>,
) -> Done {
    Done::Merged { film, rel_mse: error.map(|e| e.mean(adder.layout.size)), error, tiles, non_finite, picture }
}
