# Error of every method on every system: ours (mean over runs, smallest and largest), and as printed in the paper.
set multiplot layout 1, 3 margins 0.06, 0.99, 0.32, 0.88 spacing 0.05
set logscale y
set grid ytics lc rgb '#dddddd'
set xtics rotate by -40 left noenhanced
set key top right opaque box lc rgb '#cccccc'
set xrange [0.3:7.7]
cells = dir . '/table1_cells.csv'
is(system, protocol) = strcol('system') eq system && strcol('protocol') eq protocol && column('rmse_mean') > 0
do for [s in 'surface unicycle duffing'] {
  set title s
  if (s eq 'surface') { set ylabel 'normalised rmse' } else { unset ylabel }
  plot cells using (is(s, 'default') ? column('method_index') - 0.15 : NaN):'rmse_mean':'rmse_min':'rmse_max' \
         with yerrorbars pt 7 ps 0.9 lw 2 lc rgb '#1f77b4' title 'default protocol', \
       cells using (is(s, 'paper') ? column('method_index') : NaN):'rmse_mean':'rmse_min':'rmse_max' \
         with yerrorbars pt 5 ps 0.9 lw 2 lc rgb '#d95f02' title 'paper protocol', \
       cells using (is(s, 'paper') || is(s, 'default') ? column('method_index') + 0.15 : NaN):'printed_rmse_mean':'printed_rmse_min':'printed_rmse_max' \
         with yerrorbars pt 6 ps 0.9 lw 1 lc rgb '#555555' title 'printed', \
       cells using 'method_index':(NaN):xticlabel('method') notitle
}
unset multiplot
