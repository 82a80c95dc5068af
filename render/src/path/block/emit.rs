//! What comes of the vertices of a block: shadow rays and next rays.

use glam::Vec3;

use super::{Block, N};
use crate::path::vertex::Fate;
use crate::path::{Outcome, PathRay, ShadowRay};
use crate::ray::{PathKey, Ray};

impl Block {
    /// Appends what came of vertices none of which passes: without branches that depend on them.
    pub(super) fn emit(&mut self, out: &mut Outcome) {
        let (mut shadows, mut nexts) = ([0u8; N], [0u8; N]);
        let (mut shadow, mut next, mut roulette) = (0, 0, 0);
        for i in 0..self.len {
            // written before it is known whether it counts
            shadows[shadow & (N - 1)] = i as u8;
            shadow += usize::from(self.casts[i]);
            nexts[next & (N - 1)] = i as u8;
            next += usize::from(self.fate[i] == Fate::On);
            roulette += u64::from(self.fate[i] == Fate::Roulette);
        }
        out.counters.roulette += roulette;
        out.counters.absorbed += (self.len - next) as u64 - roulette;
        let place = |i: &u8| usize::from(*i) & (N - 1);
        let (shadows, nexts) = (&shadows[..shadow], &nexts[..next]);
        out.shadow.extend(shadows.iter().map(|i| self.shadow(place(i))));
        out.shadow_rays.extend(shadows.iter().map(|i| self.shadow_ray(place(i))));
        out.next.extend(nexts.iter().map(|i| self.next(place(i))));
        out.next_rays.extend(nexts.iter().map(|i| self.next_ray(place(i))));
    }

    /// The same in the order of the vertices, where some pass.
    pub(super) fn emit_mixed(&mut self, out: &mut Outcome, mut plain: impl FnMut(usize, PathKey, Vec3, &mut Outcome)) {
        for i in 0..self.len {
            if self.passes[i] {
                plain(self.index[i] as usize, self.key[i], self.throughput.get(i), out);
                continue;
            }
            if self.casts[i] {
                out.shadow.push(self.shadow(i));
                out.shadow_rays.push(self.shadow_ray(i));
            }
            match self.fate[i] {
                Fate::On => {
                    out.next.push(self.next(i));
                    out.next_rays.push(self.next_ray(i));
                }
                Fate::Absorbed => out.counters.absorbed += 1,
                Fate::Roulette => out.counters.roulette += 1,
            }
        }
    }

    #[inline(always)]
    fn shadow(&self, i: usize) -> ShadowRay {
        ShadowRay {
            o: self.shadow_o.get(i).to_array(),
            dir: self.shadow_dir[i],
            tmax: self.light_tmax[i],
            contribution: self.contribution.get(i).to_array(),
            key: self.key[i],
        }
    }
    #[inline(always)]
    fn shadow_ray(&self, i: usize) -> Ray {
        let (o, d) = (self.shadow_o.get(i).to_array(), self.shadow_d.get(i).to_array());
        Ray { o, tmin: 0.0, d, tmax: self.light_tmax[i] }
    }
    #[inline(always)]
    fn next(&self, i: usize) -> PathRay {
        PathRay {
            o: self.next_o.get(i).to_array(),
            dir: self.next_dir[i],
            key: PathKey { vertex: self.key[i].vertex + 1, ..self.key[i] },
            throughput: self.next_throughput.get(i).to_array(),
            pdf: self.next_pdf[i],
        }
    }
    #[inline(always)]
    fn next_ray(&self, i: usize) -> Ray {
        let (o, d) = (self.next_o.get(i).to_array(), self.next_d.get(i).to_array());
        Ray { o, tmin: 0.0, d, tmax: f32::INFINITY }
    }
}
