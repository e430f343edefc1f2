//! Reads the file of a drive.

use std::error::Error;

use crate::revisit::v1::{
    pose::{Orientation, Position},
    Covariance, CovarianceForm, LocalPosition, Pose, PoseColumns,
};

const COVARIANCE: [&str; 6] = ["pxx", "pxy", "pxt", "pyy", "pyt", "ptt"];

/// Reads the poses, which number from 1 in the order of the file.
pub fn read(path: &str) -> Result<Vec<Pose>, Box<dyn Error>> {
    let text = std::fs::read_to_string(path)?;
    let mut lines = text.lines();
    let names: Vec<&str> = lines
        .next()
        .ok_or("the file is empty")?
        .split(',')
        .collect();
    (1..)
        .zip(lines)
        .map(|(sequence, line)| {
            let fields: Vec<&str> = line.split(',').collect();
            make_pose(sequence, |name| {
                let at = names.iter().position(|other| *other == name);
                let field = at
                    .and_then(|at| fields.get(at))
                    .ok_or(format!("no {name}"))?;
                Ok(field.parse()?)
            })
            .map_err(|error| format!("{path}:{}: {error}", sequence + 1).into())
        })
        .collect()
}

fn make_pose(
    sequence: u64,
    column: impl Fn(&str) -> Result<f64, Box<dyn Error>>,
) -> Result<Pose, Box<dyn Error>> {
    let time = column("t_s")?;
    Ok(Pose {
        sequence,
        stamp: Some(prost_types::Timestamp {
            seconds: time.floor() as i64,
            nanos: ((time - time.floor()) * 1e9).round() as i32,
        }),
        position: Some(Position::Local(LocalPosition {
            x_meters: column("est_x")?,
            y_meters: column("est_y")?,
            z_meters: 0.0,
        })),
        orientation: Some(Orientation::HeadingRadians(column("est_yaw")?)),
        covariance: Some(Covariance {
            form: CovarianceForm::Planar6.into(),
            values: COVARIANCE
                .into_iter()
                .map(column)
                .collect::<Result<_, _>>()?,
        }),
        // A field that a later version adds is left out, and the program compiles.
        ..Pose::default()
    })
}

/// The poses as columns, which take less to send and to read. All poses of this drive have
/// the same fields, or they would be messages.
pub fn columns_of(poses: &[Pose]) -> PoseColumns {
    let mut columns = PoseColumns {
        first_sequence: poses[0].sequence,
        pose_count: poses.len() as i32,
        first_stamp: poses[0].stamp,
        covariance_form: CovarianceForm::Planar6.into(),
        ..PoseColumns::default()
    };
    for pose in poses {
        if let Some(Position::Local(local)) = pose.position {
            columns.x_meters.push(local.x_meters);
            columns.y_meters.push(local.y_meters);
        }
        if let Some(Orientation::HeadingRadians(heading)) = pose.orientation {
            columns.heading_radians.push(heading);
        }
        if let Some(covariance) = &pose.covariance {
            columns.covariances.extend(&covariance.values);
        }
    }
    let stamps: Vec<i64> = poses.iter().map(nanoseconds_of).collect();
    columns.stamp_step_nanos = stamps.windows(2).map(|pair| pair[1] - pair[0]).collect();
    columns
}

fn nanoseconds_of(pose: &Pose) -> i64 {
    let stamp = pose.stamp.unwrap_or_default();
    stamp.seconds * 1_000_000_000 + i64::from(stamp.nanos)
}
