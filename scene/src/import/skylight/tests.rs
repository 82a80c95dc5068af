use super::*;
use crate::import::vector::normalize;

/// Turbidity, albedo, direction of the sun; radiance of a sun of 10 degrees; directions and radiances of the sky: what Mitsuba 3.9.1's `sunsky`
/// (scalar_rgb) returned for them.
type Case = (f64, [f64; 3], [f64; 3], [f64; 3], &'static [([f64; 3], [f64; 3])]);

const MITSUBA: &[Case] = &[
    (
        3.0,
        [0.3, 0.3, 0.3],
        [0.6187, -0.7748, 0.1298],
        [35.3106, 19.11, 5.04595],
        &[
            ([-0.568, -0.453, 0.216], [0.0382299, 0.0542822, 0.0615063]),
            ([-2.02, -0.232, 0.865], [0.0316209, 0.0468754, 0.057235]),
            ([3.323, 0.226, 0.353], [0.0903424, 0.0981644, 0.0764887]),
            ([-0.281, -0.668, 1.055], [0.0127365, 0.0219195, 0.0328358]),
        ],
    ),
    (
        1.0,
        [0.0, 0.5, 1.0],
        [-0.5847, 0.721, 0.3719],
        [58.3925, 43.9661, 25.9284],
        &[
            ([0.958, -0.2, 0.024], [0.123359, 0.207587, 0.23921]),
            ([1.546, 0.545, 0.505], [0.0389297, 0.0873486, 0.159166]),
            ([-0.183, 0.541, 1.935], [0.0105871, 0.030262, 0.0685962]),
            ([-0.27, -0.244, 1.002], [0.00978622, 0.0284599, 0.0666454]),
        ],
    ),
    (
        7.3,
        [0.2, 0.1, 0.6],
        [-0.6865, -0.2259, 0.6912],
        [51.2986, 41.2732, 30.5272],
        &[
            ([0.58, 0.092, 0.67], [0.0352322, 0.053441, 0.113551]),
            ([-2.828, 1.021, 0.96], [0.20807, 0.223547, 0.305527]),
            ([-1.669, 0.276, 0.701], [0.285634, 0.296988, 0.353325]),
            ([-0.445, -1.076, 0.026], [0.21709, 0.1942, 0.263203]),
        ],
    ),
    (
        10.0,
        [0.9, 0.9, 0.9],
        [-0.0329, 0.8772, 0.4789],
        [25.3326, 18.2024, 12.506],
        &[
            ([0.194, 1.112, 0.206], [1.04491, 0.872706, 0.657219]),
            ([-0.926, 0.584, 0.583], [0.187316, 0.185922, 0.184503]),
            ([-0.215, -0.783, 0.229], [0.104569, 0.107062, 0.125896]),
            ([-2.494, 0.69, 0.491], [0.176184, 0.163228, 0.161529]),
        ],
    ),
    (
        2.5,
        [0.0, 0.0, 0.0],
        [-0.8592, 0.0322, 0.5107],
        [59.2269, 46.8053, 31.36],
        &[
            ([0.757, -2.034, 0.914], [0.0333503, 0.0612993, 0.105836]),
            ([0.71, 1.156, 2.158], [0.0148378, 0.0297619, 0.0602642]),
            ([-0.498, 0.328, 0.609], [0.0407196, 0.0622485, 0.0993831]),
            ([1.591, -1.191, 0.355], [0.0727035, 0.118183, 0.167807]),
        ],
    ),
];

fn skylight(turbidity: f64, albedo: [f64; 3], sun: [f64; 3]) -> Skylight {
    Skylight { turbidity, albedo, sun: normalize(sun).unwrap(), scale: 1.0, to_world: Affine::IDENTITY }
}

/// The radiance of a direction of the model: y is up in the picture.
fn looked_up(picture: &SkyMap, d: [f64; 3]) -> [f64; 3] {
    picture.radiance([d[0] as f32, d[2] as f32, -d[1] as f32].into()).to_array().map(f64::from)
}

#[test]
fn radiances_are_mitsubas() {
    for (turbidity, albedo, sun, of_sun, directions) in MITSUBA {
        let sky = skylight(*turbidity, *albedo, *sun);
        let dome = Dome::new(&sky);
        let picture = picture(&sky);
        for (d, expected) in *directions {
            let d = normalize(*d).unwrap();
            let found = dome.radiance(d);
            let seen = looked_up(&picture, d);
            for c in 0..3 {
                assert!((found[c] / expected[c] - 1.0).abs() < 2e-5, "{turbidity} {d:?}: {found:?} {expected:?}");
                assert!((seen[c] / expected[c] - 1.0).abs() < 1e-3, "{turbidity} {d:?}: {seen:?} {expected:?}");
            }
        }
        let height = normalize(*sun).unwrap()[2];
        let solid_angle = 2.0 * PI * (1.0 - 5f64.to_radians().cos());
        let found = sun_irradiance(*turbidity, height).map(|v| v / solid_angle);
        for c in 0..3 {
            assert!((found[c] / of_sun[c] - 1.0).abs() < 1e-4, "{turbidity}: {found:?} {of_sun:?}");
        }
    }
}

/// What `SIZE` promises: the upper half's integral, and single directions between rows and columns.
#[test]
fn the_picture_is_the_model() {
    for (turbidity, elevation) in [(3.0, 24.0f64), (1.0, 5.0), (8.0, 60.0), (2.0, 85.0)] {
        let (sin, cos) = elevation.to_radians().sin_cos();
        let sky = skylight(turbidity, [0.3; 3], [cos, 0.0, sin]);
        let (dome, picture) = (Dome::new(&sky), picture(&sky));
        let (mut exact, mut baked) = ([0.0; 3], [0.0; 3]);
        let n = 1024;
        for row in 0..n {
            // midpoints between the picture's rows
            let from_top = FRAC_PI_2 * (f64::from(row) + 0.5) / f64::from(n / 2);
            if from_top > FRAC_PI_2 {
                break;
            }
            let (s, up) = from_top.sin_cos();
            for column in (0..n).step_by(7) {
                let turn = 2.0 * PI * f64::from(column) / f64::from(n);
                let d = [s * turn.sin(), s * turn.cos(), up];
                let expected = dome.radiance(d);
                let found = looked_up(&picture, d);
                for c in 0..3 {
                    exact[c] += expected[c] * s;
                    baked[c] += found[c] * s;
                    // within a row of the horizon, and above it
                    let bound = match n / 2 - row {
                        1 => 0.1,
                        2 => 0.01,
                        _ => 0.004,
                    };
                    let error = found[c] / expected[c] - 1.0;
                    assert!(error.abs() < bound, "{turbidity} {elevation} {d:?}: {found:?} {expected:?}");
                }
            }
        }
        for c in 0..3 {
            assert!((baked[c] / exact[c] - 1.0).abs() < 2e-4, "{turbidity} {elevation}: {baked:?} {exact:?}");
        }
        // dark below
        assert_eq!(looked_up(&picture, normalize([0.3, 0.2, -0.5]).unwrap()), [0.0; 3]);
    }
}

/// Whatever the numbers, nothing is negative or not finite.
#[test]
fn extremes_are_finite() {
    for turbidity in [1.0, 1.5, 9.99, 10.0] {
        for albedo in [0.0, 1.0] {
            for height in [0.0, 1e-9, 0.02, 0.5, 1.0] {
                let sky = skylight(turbidity, [albedo; 3], [(1.0f64 - height * height).sqrt(), 0.0, height]);
                let dome = Dome::new(&sky);
                for i in 0..200 {
                    let up = f64::from(i) / 199.0;
                    let d = normalize([(1.0 - up * up).sqrt(), 0.0, up]).unwrap();
                    assert!(dome.radiance(d).iter().all(|v| *v >= 0.0 && *v < 1e3), "{turbidity} {height} {up}");
                }
                assert!(sun_irradiance(turbidity, height).iter().all(|v| v.is_finite() && *v >= 0.0));
            }
        }
    }
    assert_eq!(sun_irradiance(3.0, -0.1), [0.0; 3]);
}

/// Days and places where it is known: noon over Greenwich's meridian at the equinox, midsummer on the tropic, New Year 2000 (the almanac: declination
/// -23.03 degrees).
#[test]
fn the_sun_stands_where_it_does() {
    let noon = Moment {
        year: 2010,
        month: 3,
        day: 20,
        hour: 12.0,
        minute: 0.0,
        second: 0.0,
        timezone: 0.0,
        latitude: 0.0,
        longitude: 0.0,
    };
    let degrees = |at: &Moment| zenith_and_azimuth(at).0.to_degrees();
    // the equation of time: 7.5 minutes late
    assert!((degrees(&noon) - 1.86).abs() < 0.05, "{}", degrees(&noon));
    let summer = Moment { month: 6, day: 21, latitude: 23.44, minute: 1.7, ..noon };
    assert!(degrees(&summer) < 0.1, "{}", degrees(&summer));
    let year = Moment { year: 2000, month: 1, day: 1, minute: 3.1, ..noon };
    assert!((degrees(&year) - 23.03).abs() < 0.05, "{}", degrees(&year));
    // in the morning in the east, in the evening in the west
    let azimuth = |hour: f64| zenith_and_azimuth(&Moment { hour, latitude: 45.0, ..noon }).1.to_degrees();
    assert!((azimuth(8.0) - 110.0).abs() < 15.0 && (azimuth(16.0) - 250.0).abs() < 15.0);
    assert!(degrees(&Moment { hour: 0.0, ..noon }) > 170.0);
}
