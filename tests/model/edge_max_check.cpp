// Prints the relative error of edge_max and of edge_max_coarse for a width and a count of neighbours: what a processor
// that only an emulator has here makes of the kernels (test_cpu_kernels.py).

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <vector>

#include "kernels.h"

namespace {

uint32_t state = 1;
float draw() {  // roughly normal
  float sum = 0;
  for (int n = 0; n < 12; ++n) {
    state = state * 1664525u + 1013904223u;
    sum += float(state >> 8) / (1 << 24);
  }
  return sum - 6;
}

double error(const std::vector<float>& found, const std::vector<double>& expected) {
  double wrong = 0, all = 0;
  for (size_t n = 0; n < found.size(); ++n) {
    wrong += (found[n] - expected[n]) * (found[n] - expected[n]);
    all += expected[n] * expected[n];
  }
  return std::sqrt(wrong / all);
}

}  // namespace

int main(int, char** arguments) {
  const int width = std::atoi(arguments[1]), k = std::atoi(arguments[2]), count = 40;
  std::vector<float> a(count * width), b(count * width), weight(width * width), packed(width * width);
  for (auto* values : {&a, &b, &weight})
    for (float& value : *values) value = draw();
  std::vector<int32_t> index(count * k);
  for (size_t n = 0; n < index.size(); ++n) index[n] = int32_t(n * 7 % count);
  std::vector<double> expected(count * width, -1e300);
  for (int i = 0; i < count; ++i)
    for (int n = 0; n < k; ++n)
      for (int c = 0; c < width; ++c) {
        double sum = 0;
        for (int d = 0; d < width; ++d)
          sum += std::max(0.0f, a[i * width + d] + b[index[i * k + n] * width + d]) * double(weight[c * width + d]);
        expected[i * width + c] = std::max(expected[i * width + c], sum);
      }
  std::vector<float> found(count * width);
  straightpcf_pack(weight.data(), width, width, packed.data());
  straightpcf_edge_max(a.data(), b.data(), index.data(), packed.data(), count, k, width, width, found.data(), nullptr);
  std::printf("%.2e ", error(found, expected));
  straightpcf_pack_coarse(weight.data(), width, width, packed.data());
  straightpcf_edge_max_coarse(a.data(), b.data(), index.data(), packed.data(), count, count, k, width, width,
                              found.data());
  std::printf("%.2e\n", error(found, expected));
}
