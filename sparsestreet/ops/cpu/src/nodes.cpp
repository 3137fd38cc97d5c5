// What scene nodes do before their rows are splatted, and how rows learn. Compiled once per instruction set, with strict IEEE rules.
#include "activate.hpp"
#include "adam.hpp"
#include "kernels.h"
#include "poses.hpp"
#include "statistics.hpp"

namespace SPLAT_VARIANT {

void fill_node_kernels(Kernels& k) {
  k.nodes[0] = {activate<float>, activate_backward<float>, poses<float>, poses_backward<float>};
  k.adam[0] = {adam<float>}, k.adam[1] = {adam<double>};
  k.statistics[0] = {add_statistics<float>}, k.statistics[1] = {add_statistics<double>};
  k.nodes[1] = {activate<double>, activate_backward<double>, poses<double>, poses_backward<double>};
}

}  // namespace SPLAT_VARIANT
