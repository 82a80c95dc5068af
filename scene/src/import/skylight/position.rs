//! Where the sun stands: Blanco-Muriel et al. 2001, "Computing the Solar Vector", Solar Energy 70(5), within 0.5 minutes of arc from 1999 to 2015.

use std::f64::consts::{PI, TAU};

/// A time and place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in super::super) struct Moment {
    pub year: i64,
    pub month: i64,
    pub day: i64,
    /// Of the local time; hours, minutes and seconds may have fractions.
    pub hour: f64,
    pub minute: f64,
    pub second: f64,
    /// Hours that the local time is ahead of UTC.
    pub timezone: f64,
    /// Degrees north.
    pub latitude: f64,
    /// Degrees east.
    pub longitude: f64,
}

/// The sun's angle from the zenith, and its azimuth from north over east, in [0, 2 pi). Radians.
pub(in super::super) fn zenith_and_azimuth(at: &Moment) -> (f64, f64) {
    let hours = at.hour - at.timezone + (at.minute + at.second / 60.0) / 60.0;
    let days = julian_day(at.year, at.month, at.day) as f64 - 0.5 + hours / 24.0 - 2_451_545.0;
    // ecliptic
    let omega = 2.1429 - 0.001_039_459_4 * days;
    let mean = 4.895_063 + 0.017_202_791_698 * days;
    let anomaly = 6.240_06 + 0.017_201_969_9 * days;
    let longitude = mean + 0.033_416_07 * libm::sin(anomaly) + 0.000_348_94 * libm::sin(2.0 * anomaly)
        - 0.000_113_4
        - 0.000_020_3 * libm::sin(omega);
    let obliquity = 0.409_092_8 - 6.214e-9 * days + 0.000_039_6 * libm::cos(omega);
    // celestial
    let sin = libm::sin(longitude);
    let ascension = libm::atan2(libm::cos(obliquity) * sin, libm::cos(longitude));
    let declination = libm::asin(libm::sin(obliquity) * sin);
    // local
    let greenwich = 6.697_424_324_2 + 0.065_709_828_3 * days + hours;
    let hour_angle = (greenwich * 15.0 + at.longitude).to_radians() - ascension;
    let latitude = at.latitude.to_radians();
    let (sin_latitude, cos_latitude) = (libm::sin(latitude), libm::cos(latitude));
    let cos_hour = libm::cos(hour_angle);
    let height = cos_latitude * cos_hour * libm::cos(declination) + libm::sin(declination) * sin_latitude;
    let zenith = libm::acos(height.clamp(-1.0, 1.0));
    let azimuth = libm::atan2(-libm::sin(hour_angle), libm::tan(declination) * cos_latitude - sin_latitude * cos_hour);
    let azimuth = if azimuth < 0.0 { azimuth + TAU } else { azimuth };
    debug_assert!((0.0..=PI).contains(&zenith));
    // parallax: the Earth's radius over the distance of the sun
    (zenith + 6371.01 / 149_597_890.0 * libm::sin(zenith), azimuth)
}

/// The Julian day that begins at noon of a day of the Gregorian calendar (divisions round towards 0).
fn julian_day(year: i64, month: i64, day: i64) -> i64 {
    let early = (month - 14) / 12;
    (1461 * (year + 4800 + early)) / 4 + (367 * (month - 2 - 12 * early)) / 12 - (3 * ((year + 4900 + early) / 100)) / 4
        + day
        - 32_075
}
