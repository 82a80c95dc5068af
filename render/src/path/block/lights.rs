//! Choosing lights and points on them.

use super::lanes::{Lanes, set, set3};
use super::{Block, N};
use crate::light::{
    Few, FewLight, FewShape, LightSample, Node, SphereLight, TriangleLight, at_least, end, probability,
};
use crate::math::select;
use crate::path::Context;

impl Block {
    /// Chooses them and points on them.
    #[inline(always)]
    pub(super) fn lights(&mut self, context: &Context) {
        self.choose_lights(context);
        self.sample_triangles();
        self.other_lights(context);
    }

    /// Those that lie behind surfaces that light passes through, once more and from there.
    #[inline(always)]
    pub(super) fn lights_beyond(&mut self, context: &Context) {
        for i in 0..N {
            self.shadow_beyond[i] = self.lit[i] & (self.light_d.get(i).dot(self.normal.get(i)) < 0.0);
        }
        let behind = self.shadow_beyond;
        if !behind[..self.len].contains(&true) {
            return;
        }
        let (d, tmax, pdf, arriving, lit) = (self.light_d, self.light_tmax, self.light_pdf, self.arriving, self.lit);
        let (origin, passes, fewer) = (self.origin, self.passes, std::mem::take(&mut self.fewer));
        self.origin = self.beyond;
        for i in 0..N {
            self.passes[i] = !behind[i];
        }
        self.lights(context);
        (self.origin, self.passes) = (origin, passes);
        self.fewer += fewer;
        for i in 0..N {
            // the choice depends on the point: at an end of an interval it may fall on another source, perhaps in front
            let still = self.lit[i] & (self.light_d.get(i).dot(self.normal.get(i)) < 0.0);
            self.light_d.set(i, select(behind[i], self.light_d.get(i), d.get(i)));
            self.light_tmax[i] = if behind[i] { self.light_tmax[i] } else { tmax[i] };
            self.light_pdf[i] = if behind[i] { self.light_pdf[i] } else { pdf[i] };
            self.arriving.set(i, select(behind[i], self.arriving.get(i), arriving.get(i)));
            self.lit[i] = if behind[i] { still } else { lit[i] };
        }
    }

    #[inline(always)]
    fn choose_lights(&mut self, context: &Context) {
        let any_triangle = |few: &[FewLight]| few.iter().any(|light| matches!(light.shape, FewShape::Triangle(_)));
        match context.lights.few() {
            Some(Few::ByPower(few)) => {
                self.any_triangle = any_triangle(few);
                return self.choose_by_power(few);
            }
            Some(Few::ByPlace(node, few)) => {
                self.any_triangle = any_triangle(few);
                return self.choose_by_place(node, few);
            }
            None => self.any_triangle = false,
        }
        for i in 0..self.len {
            self.is_ball[i] = false;
            // where a vertex passes there is no point to choose for
            let facing = self.facing(i);
            let (chosen, fewer) = if self.passes[i] {
                (None, false)
            } else {
                context.lights.choose(self.origin.get(i), facing, self.choice[i])
            };
            // what is seen from behind is black whatever shines there
            self.fewer += u64::from(fewer & self.seen[i]);
            self.chosen[i] = chosen;
            let Some(choice) = self.chosen[i] else { continue };
            (self.probability[i], self.worth[i]) = (choice.probability, choice.worth);
            let Some((triangle, radiance)) = context.lights.triangle(choice) else {
                if let Some((sphere, radiance)) = context.lights.sphere(choice, self.origin.get(i)) {
                    self.is_ball[i] = true;
                    self.light_center.set(i, sphere.center());
                    self.light_radius[i] = sphere.radius();
                    self.radiance.set(i, radiance);
                }
                continue;
            };
            self.any_triangle = true;
            self.light_p0.set(i, triangle.p0);
            self.light_e1.set(i, triangle.e1);
            self.light_e2.set(i, triangle.e2);
            self.light_normal.set(i, triangle.normal);
            self.light_area[i] = triangle.area;
            self.light_error[i] = triangle.error;
            self.radiance.set(i, radiance);
        }
    }

    /// By comparing each number with each source: the last whose interval begins at or before it.
    #[inline(always)]
    fn choose_by_power(&mut self, few: &[FewLight]) {
        self.is_ball = [false; N];
        self.worth = Lanes([1.0; N]);
        for light in few {
            // bits all 1 where it is chosen: a select of floats would be unrolled into branches
            let mut mask = [0; N];
            for i in 0..N {
                mask[i] = if self.choice[i] >= light.start { u32::MAX } else { 0 };
            }
            self.take(light, &mask);
            set(&mut self.probability, light.probability, &mask);
        }
    }

    /// As [`crate::light::Lights::choose`] does in the tree's only node: by the interval in which each number lies.
    #[inline(always)]
    fn choose_by_place(&mut self, node: &Node, few: &[FewLight]) {
        const MOST: usize = 8;
        self.is_ball = [false; N];
        let few = &few[..few.len().min(MOST)];
        let (mut sums, mut counts, mut importances) = ([[0.0; N]; MOST], [[0; N]; MOST], [[0.0; N]; MOST]);
        let (mut all, mut facing, mut count) = ([0.0; N], [0.0; N], [0; N]);
        for k in 0..few.len() {
            for i in 0..N {
                let o = self.origin.get(i);
                let importance = node.importance(k, o);
                importances[k][i] = importance;
                all[i] += importance;
                facing[i] += importance * node.faces(k, o, self.facing(i));
                count[i] += u32::from(importance > 0.0);
                (sums[k][i], counts[k][i]) = (facing[i], count[i]);
            }
        }
        let (mut fewer, most) = (0u32, few.len() as u32);
        for i in 0..N {
            let is_fewer = count[i] < most;
            fewer += u32::from((i < self.len) & is_fewer & self.seen[i] & !self.passes[i]);
        }
        self.fewer = u64::from(fewer);
        let (mut begin, mut numbers, mut importance) = ([0; N], [0; N], [0.0; N]);
        for (k, light) in few.iter().enumerate() {
            let mut mask = [0; N];
            for i in 0..N {
                // where none shines there are no numbers to choose by
                let length = if count[i] > 0 { 1 << 32 } else { 0 };
                let end = end((sums[k][i], facing[i]), (counts[k][i], count[i]), length);
                let number = u64::from(self.choice[i]);
                let is_chosen = (number >= begin[i]) & (number < end);
                numbers[i] = if is_chosen { end - begin[i] } else { numbers[i] };
                mask[i] = if is_chosen { u32::MAX } else { 0 };
                begin[i] = end;
            }
            for i in 0..N {
                importance[i] = if mask[i] != 0 { importances[k][i] } else { importance[i] };
            }
            self.take(light, &mask);
        }
        for i in 0..N {
            let truly = probability(numbers[i]);
            let seen = at_least(importance[i] / all[i]);
            // 0 where nothing was chosen
            self.probability[i] = if truly > 0.0 { seen } else { 0.0 };
            self.worth[i] = seen / truly;
        }
    }

    /// Takes a light where the mask's bits are 1.
    #[inline(always)]
    fn take(&mut self, FewLight { shape, radiance, .. }: &FewLight, mask: &[u32; N]) {
        // written out: of loops over vectors and their components the compiler makes gathers and scatters across these
        set3(&mut self.radiance, *radiance, mask);
        let is_sphere = matches!(shape, FewShape::Sphere(_));
        for i in 0..N {
            self.is_ball[i] = if mask[i] != 0 { is_sphere } else { self.is_ball[i] };
        }
        match shape {
            FewShape::Triangle(light) => {
                set3(&mut self.light_p0, light.p0, mask);
                set3(&mut self.light_e1, light.e1, mask);
                set3(&mut self.light_e2, light.e2, mask);
                set3(&mut self.light_normal, light.normal, mask);
                set(&mut self.light_area, light.area, mask);
                set(&mut self.light_error, light.error, mask);
            }
            FewShape::Sphere(light) => {
                set3(&mut self.light_center, light.center(), mask);
                set(&mut self.light_radius, light.radius(), mask);
            }
        }
    }

    /// Points on triangles, where one was chosen.
    #[inline(always)]
    fn sample_triangles(&mut self) {
        if !self.any_triangle {
            self.lit = [false; N];
        } else if self.kind.transmits() {
            self.points_on_triangles::<false>();
        } else {
            self.points_on_triangles::<true>();
        }
    }

    /// `WARPS`: surfaces are lit from one side.
    #[inline(always)]
    fn points_on_triangles<const WARPS: bool>(&mut self) {
        for i in 0..N {
            let light = TriangleLight {
                p0: self.light_p0.get(i),
                e1: self.light_e1.get(i),
                e2: self.light_e2.get(i),
                normal: self.light_normal.get(i),
                area: self.light_area[i],
                error: self.light_error[i],
            };
            let o = self.origin.get(i);
            let place = [self.place[0][i], self.place[1][i]];
            let (place, warp) = if WARPS { light.warp(o, self.facing(i), place) } else { (place, 1.0) };
            self.arriving.set(i, self.radiance.get(i) * (self.worth[i] * warp));
            let (d, tmax, pdf, ok) = light.sample_or_not(o, place);
            self.light_d.set(i, d);
            self.light_tmax[i] = tmax;
            self.light_pdf[i] = pdf * self.probability[i];
            self.lit[i] = ok & (self.probability[i] > 0.0);
        }
    }

    /// Spheres, where there is one.
    #[inline(always)]
    fn sample_balls(&mut self) {
        if !self.is_ball[..self.len].contains(&true) {
            return;
        }
        for i in 0..N {
            let sphere = SphereLight::new(self.light_center.get(i).to_array(), self.light_radius[i], false);
            let o = self.origin.get(i);
            let (d, tmax, pdf) = sphere.sample_outside(o, [self.place[0][i], self.place[1][i]]);
            let yes = self.is_ball[i];
            let arriving = self.radiance.get(i) * self.worth[i];
            self.arriving.set(i, select(yes, arriving, self.arriving.get(i)));
            let lit = sphere.is_lit_outside(o) & (self.probability[i] > 0.0);
            self.light_d.set(i, select(yes, d, self.light_d.get(i)));
            self.light_tmax[i] = if yes { tmax } else { self.light_tmax[i] };
            self.light_pdf[i] = if yes { pdf * self.probability[i] } else { self.light_pdf[i] };
            self.lit[i] = if yes { lit } else { self.lit[i] };
        }
    }

    /// Sources that are neither, one by one; and where nothing was chosen there is no light.
    #[inline(always)]
    fn other_lights(&mut self, context: &Context) {
        self.sample_balls();
        if context.lights.few().is_some() {
            return;
        }
        let far_sky = context.lights.has_far_sky();
        let (mut skies, mut lanes, mut count) = ([[0; 2]; N], [0u8; N], 0);
        let mut probability = 0.0;
        for i in 0..self.len {
            let Some(choice) = self.chosen[i] else {
                self.lit[i] = false;
                continue;
            };
            if far_sky && context.lights.is_sky(choice) {
                // all of one probability
                probability = choice.probability;
                (skies[count], lanes[count]) = ([self.place_bits[0][i], self.place_bits[1][i]], i as u8);
                count += 1;
                continue;
            }
            if self.is_ball[i] || context.lights.only_triangles() || context.lights.triangle(choice).is_some() {
                continue;
            }
            let place = [self.place_bits[0][i], self.place_bits[1][i]];
            let facing = self.facing(i);
            let light = context.lights.sample_chosen(choice, self.origin.get(i), facing, place);
            self.take_light(context, i, light);
        }
        if count > 0 {
            context.lights.sample_skies(probability, &skies[..count], |k, light| {
                self.take_light(context, usize::from(lanes[k]) & (N - 1), light);
            });
        }
    }

    #[inline(always)]
    fn take_light(&mut self, context: &Context, i: usize, light: Option<LightSample>) {
        self.lit[i] = light.is_some();
        if let Some(light) = light {
            self.light_d.set(i, light.d);
            self.light_tmax[i] = light.tmax;
            self.light_pdf[i] = light.pdf;
            self.arriving.set(i, context.radiance(&light));
        }
    }
}
