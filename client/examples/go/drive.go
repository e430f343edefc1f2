package main

import (
	"encoding/csv"
	"fmt"
	"math"
	"os"
	"strconv"

	"google.golang.org/protobuf/types/known/timestamppb"

	revisitv1 "integrate/gen/revisit/v1"
)

// columns are those of the file that a pose is made of, in the order of makePose.
var columns = []string{
	"t_s", "est_x", "est_y", "est_yaw", "pxx", "pxy", "pxt", "pyy", "pyt", "ptt",
}

// readDrive reads the poses of a drive, which number from 1 in the order of the file.
func readDrive(path string) ([]*revisitv1.Pose, error) {
	file, err := os.Open(path)
	if err != nil {
		return nil, err
	}
	defer file.Close()
	rows, err := csv.NewReader(file).ReadAll()
	if err != nil {
		return nil, err
	}
	if len(rows) == 0 {
		return nil, fmt.Errorf("%s is empty", path)
	}
	index := make(map[string]int)
	for i, name := range rows[0] {
		index[name] = i
	}
	var poses []*revisitv1.Pose
	for line, row := range rows[1:] {
		numbers := make([]float64, len(columns))
		for i, name := range columns {
			column, ok := index[name]
			if !ok {
				return nil, fmt.Errorf("%s has no column %s", path, name)
			}
			if numbers[i], err = strconv.ParseFloat(row[column], 64); err != nil {
				return nil, fmt.Errorf("%s:%d: %w", path, line+2, err)
			}
		}
		poses = append(poses, makePose(uint64(line+1), numbers))
	}
	return poses, nil
}

func makePose(sequence uint64, numbers []float64) *revisitv1.Pose {
	seconds, fraction := math.Modf(numbers[0])
	return &revisitv1.Pose{
		Sequence: sequence,
		Stamp: &timestamppb.Timestamp{
			Seconds: int64(seconds), Nanos: int32(math.Round(fraction * 1e9)),
		},
		Position: &revisitv1.Pose_Local{Local: &revisitv1.LocalPosition{
			XMeters: numbers[1], YMeters: numbers[2],
		}},
		Orientation: &revisitv1.Pose_HeadingRadians{HeadingRadians: numbers[3]},
		Covariance: &revisitv1.Covariance{
			Form:   revisitv1.CovarianceForm_COVARIANCE_FORM_PLANAR_6,
			Values: numbers[4:],
		},
	}
}

// columnsOf returns the poses as columns, which take less to send and to read. All poses
// of this drive have the same fields, or they would be messages.
func columnsOf(poses []*revisitv1.Pose) *revisitv1.PoseColumns {
	columns := &revisitv1.PoseColumns{
		FirstSequence:  poses[0].GetSequence(),
		PoseCount:      int32(len(poses)),
		FirstStamp:     poses[0].GetStamp(),
		CovarianceForm: revisitv1.CovarianceForm_COVARIANCE_FORM_PLANAR_6,
	}
	for i, pose := range poses {
		if i > 0 {
			step := pose.GetStamp().AsTime().Sub(poses[i-1].GetStamp().AsTime())
			columns.StampStepNanos = append(columns.StampStepNanos, step.Nanoseconds())
		}
		columns.XMeters = append(columns.XMeters, pose.GetLocal().GetXMeters())
		columns.YMeters = append(columns.YMeters, pose.GetLocal().GetYMeters())
		columns.HeadingRadians = append(columns.HeadingRadians, pose.GetHeadingRadians())
		columns.Covariances = append(columns.Covariances, pose.GetCovariance().GetValues()...)
	}
	return columns
}
