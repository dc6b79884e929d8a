/* hilbo-world: the simulated world alone, with the options of hilbo-device. Each line of stdin is the motor's force for
 * one tick, positive inwards; each line of stdout what the tick ends with: encoder counts, position, velocity, sensed. */
#include <stdio.h>
#include <stdlib.h>

#include "../host/options.h"

int main(int count, char **arguments)
{
    static struct sim_world world;
    static struct options options;
    char line[64];
    if (!options_read(&options, count, arguments)) {
        return 2;
    }
    sim_world_start(&world, &options.rig.world);
    while (fgets(line, sizeof line, stdin) != NULL) {
        sim_world_tick(&world, strtod(line, NULL));
        (void)printf("%ld %.17g %.17g %.17g\n", (long)sim_world_counts(&world), world.position_mm,
                     world.velocity_mm_per_s, sim_world_sensed_N(&world));
    }
    return EXIT_SUCCESS;
}
