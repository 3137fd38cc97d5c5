// Compiled once per instruction set, with the rules of arithmetic loosened so that the loops vectorize.
#include "blend.hpp"
#include "blend_backward.hpp"
#include "contribution.hpp"
#include "kernels.h"
#include "leave_one_out.hpp"

namespace SPLAT_VARIANT {
namespace {

template <class T>
Workspace<T>& as(void* workspace) { return *static_cast<Workspace<T>*>(workspace); }

template <class T>
PixelKernels kernels() {
  return {[](void* w, const View& v, bool gated, const Layers& image) { blend(as<T>(w), v, gated, image); },
          [](void* w, const View& v, const void* transmittance, const Finishers& out) {
            write_finishers(as<T>(w), v, static_cast<const T*>(transmittance), out);
          },
          [](void* w, const View& v, const void* transmittance, const Layers& cotangents, int64_t rows, void* gates) {
            blend_backward(as<T>(w), v, static_cast<const T*>(transmittance), cotangents, rows, static_cast<T*>(gates));
          },
          [](void* w, const View& v, int64_t rows, const Counters& out) {
            count_contributions(as<T>(w), v, rows, out);
          },
          [](void* w, const View& v, int64_t rows, const Backdrop& sky_image, int64_t ways, const Layers* drawn,
             const Changes& out) {
            ways == 1 ? remove_rows<T, 1>(as<T>(w), v, rows, sky_image, drawn, out)
                      : remove_rows<T, COUNTINGS>(as<T>(w), v, rows, sky_image, drawn, out);
          }};
}

}  // namespace

void fill_pixel_kernels(Kernels& k) { k.pixels[0] = kernels<float>(), k.pixels[1] = kernels<double>(); }

}  // namespace SPLAT_VARIANT
