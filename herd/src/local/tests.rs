use super::*;
use crate::job::{NodeSpec, Silent};
use crate::plan::Strategy;
use crate::testing;

fn sampling(spp: u32) -> Sampling {
    Sampling { spp, target_error: None, time_limit: None }
}

fn plain(scene: &PreparedScene, frame: &Frame, spp: u32) -> JobOutcome {
    render_local(scene, frame, &sampling(spp), &JobSettings::default(), &Silent).unwrap()
}

#[test]
fn every_strategy_makes_the_same_bytes() {
    let whole = testing::prepared(&testing::cornell(), 1, true);
    let frame = testing::frame(&whole, [40, 24], 2);
    let expected = plain(&whole, &frame, 5);
    assert!(expected.image.pixels.iter().flatten().sum::<f32>() > 10.0);
    for reduced in [true, false] {
        for splits in [1, 4, 9] {
            let scene = testing::prepared(&testing::cornell(), splits, reduced);
            let largest = (0..scene.splits()).map(|s| scene.split_bytes(s)).max().unwrap();
            for strategy in Strategy::ALL {
                for nodes in [vec![1], vec![2, 1, 1]] {
                    let memory = Some(2 * largest);
                    let settings = JobSettings {
                        strategy,
                        nodes: nodes.iter().map(|&slots| NodeSpec { slots }).collect(),
                        memory_per_node: memory,
                        replicas: nodes.len().min(2) as u32,
                        batch: 300,
                        ray_buffer: 1 << 16,
                        ..JobSettings::default()
                    };
                    let made = render_local(&scene, &frame, &sampling(5), &settings, &Silent);
                    let made = made.unwrap_or_else(|e| panic!("{strategy} {splits} {reduced} {nodes:?}: {e}"));
                    assert!(made.film == expected.film, "{strategy}, {splits} splits, reduced {reduced}, {nodes:?}");
                    assert_eq!(made.report.rays, expected.report.rays);
                }
            }
        }
    }
}
