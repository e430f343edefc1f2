// Command integrate streams a drive to revisit, prints where the vehicle has been
// before, and confirms one of these places.
//
// usage: integrate ADDRESS FILE VEHICLE_ID
//
// With two arguments it prints what becomes of stored candidates instead.
//
// usage: integrate ADDRESS CURSOR_FILE
package main

import (
	"context"
	"fmt"
	"log"
	"os"
	"time"

	"google.golang.org/grpc"
	"google.golang.org/grpc/credentials/insecure"
	"google.golang.org/grpc/keepalive"
	"google.golang.org/grpc/status"

	revisitv1 "integrate/gen/revisit/v1"
)

//go:generate ./generate.sh

func main() {
	log.SetFlags(0)
	if len(os.Args) != 3 && len(os.Args) != 4 {
		log.Fatal("usage: integrate ADDRESS FILE VEHICLE_ID | integrate ADDRESS CURSOR_FILE")
	}
	if err := run(context.Background(), os.Args[1], os.Args[2:]); err != nil {
		log.Fatal(err)
	}
}

func run(ctx context.Context, address string, arguments []string) error {
	conn, err := grpc.NewClient(address,
		grpc.WithTransportCredentials(insecure.NewCredentials()),
		// A connection whose other end has vanished is noticed after half a minute.
		grpc.WithKeepaliveParams(keepalive.ClientParameters{
			Time: 20 * time.Second, Timeout: 10 * time.Second,
		}))
	if err != nil {
		return err
	}
	defer conn.Close()
	client := revisitv1.NewPoseGraphServiceClient(conn)
	if len(arguments) == 1 {
		return watch(ctx, client, arguments[0])
	}
	return integrate(ctx, client, arguments[0], arguments[1])
}

func integrate(ctx context.Context, client revisitv1.PoseGraphServiceClient,
	path, vehicleID string) error {
	poses, err := readDrive(path)
	if err != nil {
		return err
	}
	created, err := client.CreateVehicle(ctx, &revisitv1.CreateVehicleRequest{VehicleId: vehicleID})
	if err != nil {
		return err
	}
	vehicle := created.GetVehicle()
	fmt.Printf("vehicle: %s, uid %s\n", vehicle.GetName(), vehicle.GetUid())

	accepted, err := stream(ctx, client, vehicle, poses)
	if err != nil {
		return err
	}
	fmt.Printf("durable: all %d poses\n", len(poses))
	if len(accepted) > 0 {
		if err := confirm(ctx, client, vehicle, accepted); err != nil {
			return err
		}
	}
	return showError(ctx, client, vehicle, poses[len(poses)-1])
}

// confirm says of the most probable candidate that it is the same place, as a verifier
// would after it compared images or scans.
func confirm(ctx context.Context, client revisitv1.PoseGraphServiceClient,
	vehicle *revisitv1.Vehicle, accepted []*revisitv1.Candidate) error {
	best := accepted[0]
	for _, candidate := range accepted {
		if candidate.GetProbability() > best.GetProbability() {
			best = candidate
		}
	}
	response, err := client.AddLoopClosure(ctx, &revisitv1.AddLoopClosureRequest{
		Parent: vehicle.GetName(),
		LoopClosure: &revisitv1.LoopClosure{
			QuerySequence:   best.GetQuery().GetSequence(),
			MatchedSequence: best.GetMatched().GetSequence(),
		},
	})
	if err != nil {
		return err
	}
	fmt.Printf("confirmed: %s\n", response.GetLoopClosure().GetName())
	return nil
}

// showError sends a pose with a variance below 0, which is refused and changes nothing,
// and prints all that the error says.
func showError(ctx context.Context, client revisitv1.PoseGraphServiceClient,
	vehicle *revisitv1.Vehicle, pose *revisitv1.Pose) error {
	pose.Sequence++
	pose.Covariance.Values[0] = -1
	_, err := client.AppendPoses(ctx, &revisitv1.AppendPosesRequest{
		Vehicle: vehicle.GetName(), VehicleUid: vehicle.GetUid(),
		Poses: []*revisitv1.Pose{pose},
	})
	if err == nil {
		return fmt.Errorf("a variance of -1 was taken")
	}
	details := detailsOf(err)
	fmt.Printf("refused: %s, reason %s of %s, request %s: %s\n",
		codeName(status.Code(err)), details.info.GetReason(), details.info.GetDomain(),
		details.info.GetMetadata()["request_id"], status.Convert(err).Message())
	for _, violation := range details.badRequest.GetFieldViolations() {
		fmt.Printf("  %s: %s\n", violation.GetField(), violation.GetDescription())
	}
	return nil
}
